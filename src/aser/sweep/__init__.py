"""Tuning with Optuna, whose trials train as lanes of one program.

`study.tune` is one sweep from its settings to its files. Its loop, `study.work`, reads as if there
were one worker. `queue` lets many workers share a study.
"""
