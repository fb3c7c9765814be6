"""Experience-replay prioritisation in off-policy continuous control, many runs at once."""
