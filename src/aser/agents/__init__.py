"""The learners: pure functions of one lane."""
