"""The environments: maze, corridor and pendulum as arrays of lanes, and any other gymnasium id.

Importing this package registers aser/Maze-v0, aser/Corridor-v0 and aser/Pendulum-v0 with gymnasium.
"""

import gymnasium

from aser.envs.factory import (
    SHIPPED,
    make,
    make_single,
    module_of,
    modules_of,
    time_limit,
    wrapper_modules,
)

__all__ = [
    "SHIPPED",
    "make",
    "make_single",
    "module_of",
    "modules_of",
    "time_limit",
    "wrapper_modules",
]

for _id, _class in SHIPPED.items():
    gymnasium.register(
        _id,
        entry_point=f"aser.envs.single:{_id.removeprefix('aser/').removesuffix('-v0')}",
        vector_entry_point=f"{_class.__module__}:{_class.__name__}",
    )
