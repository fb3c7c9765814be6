"""Tuning: Optuna's trials as lanes of one program."""
