"""Estimates with their intervals, comparisons of samplers, and measures of one run."""
