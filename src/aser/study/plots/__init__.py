"""Pictures, named by what they show; they read tables and nothing else."""
