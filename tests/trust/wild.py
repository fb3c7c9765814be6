"""An environment with whatever oddities TRUST_ENVIRONMENT, a dictionary in JSON, asks for.

Without oddities it is plain: three numbers to observe (the episode, the step in it, and chance),
two to act with, and episodes of 2 to 7 steps that end in turn by themselves and by truncation.
"""

from __future__ import annotations

import json
import os
import time
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.spaces import Box

ASKED: dict[str, Any] = json.loads(os.environ.get("TRUST_ENVIRONMENT", "{}"))

OBSERVATIONS = {
    "float64": Box(-9, 9, (3,), np.float64),
    "float16": Box(-9, 9, (3,), np.float16),
    "unbounded": Box(-np.inf, np.inf, (3,), np.float32),
    "half bounded": Box(np.array([-np.inf, 0, -1]), np.array([0, np.inf, 9]), dtype=np.float64),
    "huge bounds": Box(-1e308, 1e308, (3,), np.float64),
    "equal bounds": Box(0, 0, (3,), np.float32),
    "one number": Box(-9, 9, (1,), np.float32),
    "many numbers": Box(-9, 9, (500,), np.float32),
    "empty": Box(-9, 9, (0,), np.float32),
    "0-d": Box(-9, 9, (), np.float32),
    "2-d": Box(-9, 9, (2, 3), np.float32),
    "pixels": Box(0, 255, (8, 8, 3), np.uint8),
    "bytes": Box(0, 255, (3,), np.uint8),
    "whole numbers": Box(-9, 9, (3,), np.int64),
    "Discrete": spaces.Discrete(5),
    "MultiDiscrete": spaces.MultiDiscrete([3, 4]),
    "MultiBinary": spaces.MultiBinary(3),
    "Dict": spaces.Dict({"a": Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(2)}),
    "Tuple": spaces.Tuple([Box(-1, 1, (2,), np.float32)]),
    "Text": spaces.Text(5),
    "Sequence": spaces.Sequence(spaces.Discrete(2)),
    "None": None,
    "a number": 3,
}
ACTIONS = {
    "odd bounds": Box(np.array([-3, 0.5]), np.array([-2.9, 700]), dtype=np.float32),
    "float64": Box(-1, 1, (2,), np.float64),
    "float16": Box(-1, 1, (2,), np.float16),
    "one number": Box(-2, 2, (1,), np.float32),
    "many numbers": Box(-1, 1, (40,), np.float32),
    "tiny": Box(0, 1e-40, (2,), np.float32),
    "huge": Box(-3e38, 3e38, (2,), np.float32),
    "huge float64": Box(-1e308, 1e308, (2,), np.float64),
    "beyond float32": Box(-1e200, 1e200, (2,), np.float64),
    "close bounds": Box(1e8, np.nextafter(np.float32(1e8), np.float32(2e8)), (2,), np.float32),
    "equal": Box(1, 1, (2,), np.float32),
    "one is equal": Box(np.array([0, 1]), np.array([1, 1]), dtype=np.float32),
    "infinite": Box(-np.inf, np.inf, (2,), np.float32),
    "half infinite": Box(0, np.inf, (2,), np.float32),
    "empty": Box(-1, 1, (0,), np.float32),
    "0-d": Box(-1, 1, (), np.float32),
    "2-d": Box(-1, 1, (2, 2), np.float32),
    "whole numbers": Box(-3, 3, (2,), np.int32),
    "bytes": Box(0, 255, (2,), np.uint8),
    "Discrete": spaces.Discrete(3),
    "MultiDiscrete": spaces.MultiDiscrete([2, 2]),
    "MultiBinary": spaces.MultiBinary(2),
    "Dict": spaces.Dict({"a": Box(-1, 1, (2,), np.float32)}),
    "Tuple": spaces.Tuple([Box(-1, 1, (2,), np.float32)]),
    "None": None,
    "a number": 3,
}


def read_only(obs: np.ndarray) -> np.ndarray:
    obs = obs.copy()
    obs.flags.writeable = False
    return obs


OBSERVED = {  # what is made of the proper observation
    "wrong shape": lambda obs: obs[:-1],
    "longer": lambda obs: np.append(obs, obs),
    "a column": lambda obs: obs[..., None],
    "0-d": lambda obs: np.float32(obs.sum()),
    "other type": lambda obs: obs.astype(np.int64),
    "float64": lambda obs: obs.astype(np.float64),
    "strings": lambda obs: obs.astype(str),
    "objects": lambda obs: obs.astype(object),
    "complex": lambda obs: obs + 1j,
    "out of bounds": lambda obs: obs + 1e6,
    "huge": lambda obs: obs.astype(np.float64) + 1e300,
    "nan": lambda obs: obs * np.nan,
    "inf": lambda obs: obs + np.inf,
    "a list": lambda obs: obs.tolist(),
    "a tensor": lambda obs: torch.from_numpy(np.array(obs)),
    "a number": lambda obs: 1.5,
    "a string": lambda obs: "seen",
    "a dictionary": lambda obs: {"obs": obs},
    "None": lambda obs: None,
    "read only": read_only,
    "strided": lambda obs: np.repeat(obs, 2, axis=0)[::2],
}
REWARDS = {
    "a row": np.array([-0.5]),
    "a 0-d array": np.array(-0.5),
    "two": np.array([-0.5, 1]),
    "a list": [-0.5],
    "no row": np.array([]),
    "int": -1,
    "bool": True,
    "float32": np.float32(-0.5),
    "a tensor": torch.tensor(-0.5),
    "a row tensor": torch.tensor([-0.5]),
    "nan": float("nan"),
    "inf": float("inf"),
    "-inf": float("-inf"),
    "huge": 1e300,
    "very huge int": 10**400,
    "complex": 1j,
    "a string": "good",
    "a number as text": "1.5",
    "None": None,
}
GYMNASIUMS = ["final_obs", "_final_obs", "final_info", "_final_info", "final_observation"]
GYMNASIUMS += [
    "episode",
    "_episode",
    "terminal_observation",
    "TimeLimit.truncated",
    "mask",
    "_mask",
]
INFOS = {  # from the number of steps so far
    "None": lambda t: None,
    "a list": lambda t: [1],
    "a string": lambda t: "info",
    "shapes": lambda t: {"x": np.zeros(t % 3 + 1), "y": np.zeros((t % 2 + 1, 2))},
    "types": lambda t: {"x": [1, "a", None, np.zeros(2), {"a": 1}, [1, 2], 2.5, True][t % 8]},
    "objects": lambda t: {"x": object(), "y": lambda: None, "z": {1, 2}},
    "nested": lambda t: {"x": {"y": {"z": np.zeros(t % 3 + 1)}}, "_x": 1},
    "keys": lambda t: {1: 2, None: 3, ("a", 1): 4},
    "sometimes": lambda t: {} if t % 2 else {"x": t},
    "a number, then a name": lambda t: {"x": t} if t < 5 else {"x": {"y": t}},
    "long": lambda t: {"x": "y" * 10**6},
    **{f"{name} array": lambda t, name=name: {name: np.zeros(3)} for name in GYMNASIUMS},
    **{f"{name} number": lambda t, name=name: {name: 1} for name in GYMNASIUMS},
    **{f"{name} dict": lambda t, name=name: {name: {"r": 1.0, "l": t}} for name in GYMNASIUMS},
}
INFOS["all in turn"] = lambda t: list(INFOS.values())[t % (len(INFOS) - 1)](t)
ENDS = {  # (terminated, truncated) from the step of the episode
    "never": lambda t: (False, False),
    "at once": lambda t: (True, False),
    "at once truncated": lambda t: (False, True),
    "both": lambda t: (t >= 4, t >= 4),
    "numpy": lambda t: (np.bool_(t >= 4), np.bool_(False)),
    "rows": lambda t: (np.array([t >= 4]), np.array([False])),
    "ints": lambda t: (int(t >= 4), 0),
    "floats": lambda t: (float(t >= 4), 0.0),
    "None": lambda t: (None, None),
    "strings": lambda t: ("yes" if t >= 4 else "", ""),
    "two": lambda t: (np.array([False, True]), False),
    "nan": lambda t: (float("nan"), False),
}
ERRORS = {
    "ValueError": ValueError("it went wrong"),
    "no text": RuntimeError(),
    "two lines": RuntimeError("it went wrong\nin two lines\n"),
    "a long text": RuntimeError("x" * 10_000),
    "odd characters": RuntimeError("ä\x1b[31m\u202e%s{}"),
    "AssertionError": AssertionError(),
    "KeyError": KeyError("x"),
    "StopIteration": StopIteration(),
    "OSError": OSError(28, "No space left on device"),
    "OSError without number": OSError("the simulator is gone"),
    "FileNotFoundError": FileNotFoundError(2, "No such file or directory", "assets/robot.xml"),
    "ImportError": ImportError("No module named 'mujoco'"),
    "MemoryError": MemoryError(),
    "NotImplementedError": NotImplementedError(),
    "gymnasium's": gymnasium.error.ResetNeeded("reset first"),
    "SystemExit": SystemExit(3),
    "SystemExit of success": SystemExit(0),
    "of its own": type("Base", (BaseException,), {})("not even an Exception"),
}
PLACES = ["init", "first reset", "later reset", "first step", "step 9", "step 35", "close"]
CLASHES = {  # attributes that a vector environment has, too
    "num_envs": 7,
    "single_observation_space": None,
    "single_action_space": 3,
    "envs": [],
    "unwrapped": 3,
    "spec": None,
    "metadata": None,
    "np_random": None,
    "render_mode": "human",
    "oracle": "yes",
    "best_return": "high",
    "worst_return": None,
    "state_dict": 3,
    "autoreset_mode": "NEXT_STEP",
}
LENGTHS = ["step 4", "step 6", "step None", "reset obs", "reset 3", "reset None", "step list"]


class Wild(gymnasium.Env):
    """One environment. `asked` overrides TRUST_ENVIRONMENT."""

    metadata: Any = {"render_modes": []}

    def __init__(self, render_mode: str | None = None, asked: dict[str, Any] | None = None):
        self.asked = ASKED if asked is None else asked
        self.affected = True
        self._fail("init")
        plain = Box(-9, 9, (3,), np.float32), Box(-1, 1, (2,), np.float32)
        self.observation_space = OBSERVATIONS.get(self.asked.get("observation"), plain[0])
        self.action_space = ACTIONS.get(self.asked.get("action"), plain[1])
        shape = getattr(self.observation_space, "shape", None)
        kind = getattr(self.observation_space, "dtype", None)
        self.proper = (3,) if shape is None else shape, kind or np.float32
        self.memory = np.zeros(*self.proper)  # handed out again and again where `reused` is asked
        self.episode, self.t, self.steps, self.resets = -1, 0, 0, 0
        clash = self.asked.get("clash")
        if clash == "metadata":
            self.metadata = None
        elif clash == "unwrapped":
            type(self).unwrapped = 3
        elif clash:
            setattr(self, clash, CLASHES[clash])

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        if self.asked.get("seeds") == "ignored":
            seed = None  # it draws from the system instead
        super().reset(seed=seed)
        if seed is not None:
            self.affected = not self.asked.get("one lane") or seed % 2 == 1
            self.episode = -1
        self._fail("later reset" if self.resets else "first reset")
        self.resets, self.episode, self.t = self.resets + 1, self.episode + 1, 0
        observed = self._observe(), self._info()
        return {
            "reset obs": observed[0],
            "reset 3": (*observed, 1),
            "reset None": None,
        }.get(self._odd("length"), observed)

    def step(self, action: Any) -> Any:
        if self.steps == 0 and self.asked.get("slow"):
            time.sleep(0.4)
        self._fail({0: "first step", 9: "step 9", 35: "step 35"}.get(self.steps, ""))
        self.t, self.steps = self.t + 1, self.steps + 1
        last = self.t > self.episode % 6 + 1
        ends = (last and self.episode % 2 == 0, last and self.episode % 2 == 1)
        if (odd := self._odd("ends")) is not None:
            ends = ENDS[odd](self.t)
        reward = REWARDS.get(self._odd("reward"), -float(np.square(np.asarray(action)).mean()))
        result = (self._observe(), reward, *ends, self._info())
        return {
            "step 4": result[:4],
            "step 6": (*result, 1),
            "step None": None,
            "step list": list(result),
        }.get(self._odd("length"), result)

    def close(self) -> None:
        self._fail("close")

    def _observe(self) -> Any:
        seen = np.resize(
            [self.episode / 100, self.t / 10, self.np_random.uniform()], self.proper[0]
        )
        obs = seen.astype(self.proper[1])
        if self.asked.get("reused"):
            self.memory[...] = obs
            obs = self.memory
        odd = self._odd("observed")
        late = self.asked.get("late") and self.steps < 15
        return obs if odd is None or late else OBSERVED[odd](obs)

    def _info(self) -> Any:
        odd = self._odd("info")
        return {} if odd is None else INFOS[odd](self.steps)

    def _odd(self, name: str) -> Any:
        """What is asked of `name`, where this lane is affected."""
        return self.asked.get(name) if self.affected else None

    def _fail(self, place: str) -> None:
        where, error = self.asked.get("fails", ("nowhere", ""))
        if place == where and self.affected:
            raise ERRORS[error]


class Unseeded(Wild):
    """Its reset takes no seed."""

    def reset(self) -> Any:  # type: ignore[override]
        return super().reset()


kind = Unseeded if ASKED.get("seeds") == "none" else Wild
gymnasium.register("Wild-v0", entry_point=kind, max_episode_steps=ASKED.get("limit", 20))
