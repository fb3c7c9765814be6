"""Running episodes of other libraries' environments, kept as what leads to them.

Such an environment hands out no inner state. But most of them repeat an episode to the bit when it
begins with the same random numbers and meets the same actions. So a checkpoint holds these, and the
episode is played again. Where the environment then gives other numbers, that is noticed.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np

LONGEST = 100_000  # steps of an episode that can be played again


@dataclass
class Episode:
    """The running episode of one copy: how it began, each action, and a sum of what followed."""

    began: Any  # a seed or the state of the generator; None where it is not known
    actions: list[np.ndarray] = field(default_factory=list)  # each (A,), as the copy is asked
    check: int = 0  # CRC-32 of all observations and rewards

    def note(self, observation: np.ndarray, reward: float = 0.0) -> None:
        self.check = zlib.crc32(observation.tobytes() + np.float64(reward).tobytes(), self.check)

    def taken(self, action: np.ndarray) -> None:
        if len(self.actions) == LONGEST:
            self.began, self.actions = None, []
        elif self.began is not None:
            self.actions.append(action)


def beginning(env: gymnasium.Env, seed: int | None) -> Any:
    """What the next reset of a copy depends on: its seed or, without one, its random numbers."""
    if seed is not None:
        return seed
    try:
        numbers: Any = env.unwrapped.np_random
        legacy = isinstance(numbers, np.random.RandomState)  # dm-control's
        return numbers.get_state(legacy=False) if legacy else numbers.bit_generator.state
    except KeyboardInterrupt:
        raise
    except BaseException:  # a foreign environment may raise anything
        return None


def prepare(env: gymnasium.Env, began: Any) -> int | None:
    """Bring a copy to where `beginning` was called, and return the seed for the reset.

    Raises ValueError where that cannot be done.
    """
    if began is None:
        raise ValueError("it is not known how the episode began")
    if isinstance(began, int):
        return began
    env.reset(seed=0)  # its first one makes the generator
    numbers: Any = env.unwrapped.np_random
    if isinstance(numbers, np.random.RandomState):
        key = np.array(began["state"]["key"], np.uint32)
        numbers.set_state({**began, "state": {**began["state"], "key": key}})
    else:
        numbers.bit_generator.state = began
    return None


def pack(episodes: list[Episode]) -> dict[str, list]:
    """Arrays and builtins, for a checkpoint."""
    began = [json.dumps(one.began, default=lambda array: array.tolist()) for one in episodes]
    return {
        "began": began,
        "actions": [np.array(one.actions) for one in episodes],
        "check": [one.check for one in episodes],
    }


def unpack(content: dict[str, list]) -> list[Episode]:
    """The episodes that `pack` made this of."""
    parts = zip(content["began"], content["actions"], content["check"], strict=True)
    return [
        Episode(json.loads(began), list(np.asarray(actions)), check)
        for began, actions, check in parts
    ]
