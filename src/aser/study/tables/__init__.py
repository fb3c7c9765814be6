"""From run folders to the committed tables of figures: this room alone loads torch."""
