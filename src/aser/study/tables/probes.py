"""A run folder -> the tables that maps are drawn from. Nothing else in the study loads a checkpoint or asks a network.

Every function takes a `runs.Run` and returns a tidy table of all its seeds; those that ask the agents also take the
file in the run folder that holds them, by default the checkpoint.
"""

from aser.study.tables.actions import over_actions
from aser.study.tables.agents import CRITERIA, agents, pendulum
from aser.study.tables.corridor import dropoffs, gates
from aser.study.tables.replay import replay, replayed, unrolls
from aser.study.tables.separation import exact, separation

__all__ = [
    "CRITERIA",
    "agents",
    "dropoffs",
    "exact",
    "gates",
    "over_actions",
    "pendulum",
    "replay",
    "replayed",
    "separation",
    "unrolls",
]
