"""Any other gymnasium environment, with the interface of the shipped ones."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, Tuple
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import FlattenObservation

from aser.envs.episodes import Episode, beginning, pack, prepare, unpack
from aser.errors import ConfigError, reason

Wrap = Callable[[gymnasium.Env], gymnasium.Env]


class ForeignVectorEnv(VectorEnv):
    """L copies of a gymnasium environment that are stepped in sequence, with SAME_STEP autoreset.

    gymnasium's SyncVectorEnv keeps the last observation of an episode only where the environment
    hands out a new array each time. Here each observation is copied when it arrives, as float32
    (L, O). `info` holds `final_obs` (L, O) and its mask `_final_obs` (L,) and nothing of the
    environment's own. A NaN in an action counts as the middle of its range.

    Of n discrete actions, the i-th one stands at -1 + 2 i / (n - 1): the action space here is a Box
    from -1 to 1 of one dimension, and the nearest one is taken. `discrete` is n, and None where
    actions are continuous.

    The best and worst return, the oracle and the inner state are unknown, so these attributes are
    None. `episodes` and `play` serve in place of the state. Raises ConfigError, with one line,
    where an environment fails or breaks gymnasium's rules.
    """

    best_return = worst_return = oracle = state_dict = load_state_dict = None

    def __init__(self, id: str, num_envs: int, wrapped: Sequence[Wrap] = (), **kwargs: Any):
        self.id, self.num_envs = id, num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.envs: list[gymnasium.Env] = []
        for _ in range(num_envs):
            self.envs.append(make_one(id, wrapped, **kwargs))
            one, first = self.envs[-1], self.envs[0]
            check_spaces(id, one.observation_space, one.action_space)
            if (one.observation_space, one.action_space) != (
                first.observation_space,
                first.action_space,
            ):
                raise ConfigError(f"env.id={id} has other spaces in each copy: equal ones are used")
        observed, action_space = self.envs[0].observation_space, self.envs[0].action_space
        assert isinstance(observed, Box)
        self.discrete, self._first_action = None, 0
        if isinstance(action_space, Discrete):
            self.discrete, self._first_action = int(action_space.n), int(action_space.start)
            action_space = Box(-1.0, 1.0, (1,), np.float32)
        assert isinstance(action_space, Box)
        self.single_observation_space = _as_float32(observed)
        self.single_action_space = action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)
        self._middle = (action_space.low + action_space.high) / 2
        self._observations = np.zeros((num_envs, *observed.shape), np.float32)
        self._resting = np.zeros(num_envs, bool)
        self._running = [Episode(None) for _ in range(num_envs)]
        spec = self.envs[0].spec
        self.time_limit = None if spec is None else spec.max_episode_steps

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        if isinstance(seed, int | np.integer):
            seed = range(seed, seed + self.num_envs)
        seeds = [None] * self.num_envs if seed is None else [int(one) for one in seed]
        for lane, one in enumerate(seeds):
            self._begin(lane, seed=one, options=options)
        self._resting[:] = False
        return self._observations.copy(), {}

    def rest(self, lanes: np.ndarray) -> None:
        """Do not step the lanes of the mask (L,) until the next reset.

        They stay at their observation, with reward 0.
        """
        self._resting |= lanes

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        actions = np.asarray(actions, dtype=self.single_action_space.dtype)
        actions = np.where(np.isnan(actions), self._middle, actions).astype(actions.dtype)
        rewards, final = np.zeros(self.num_envs), self._observations.copy()
        terminated, truncated = np.zeros((2, self.num_envs), bool)
        for lane in np.flatnonzero(~self._resting).tolist():
            env = self.envs[lane]
            facts = self._next(env, self._asked(actions[lane]))
            final[lane], rewards[lane], terminated[lane], truncated[lane] = facts
            self._running[lane].taken(actions[lane])
            self._running[lane].note(final[lane], rewards[lane])
            self._observations[lane] = final[lane]
            if terminated[lane] or truncated[lane]:
                self._begin(lane)
        info, ended = {}, terminated | truncated
        if ended.any():
            info = {"final_obs": final, "_final_obs": ended}  # (L, O), (L,)
        return self._observations.copy(), rewards, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        for env in self.envs:
            try:
                env.close()
            except KeyboardInterrupt:
                raise
            except BaseException:  # nothing depends on it any more
                continue

    def observations(self) -> np.ndarray:
        """Return the current observation of every lane, float32 (L, O), in a new array."""
        return self._observations.copy()

    def episodes(self) -> dict[str, list]:
        """The running episodes as arrays and builtins, for `play`."""
        return pack(self._running)

    def play(self, content: dict[str, list]) -> bool:
        """Go on with the episodes that `episodes` gave, by playing them again in each lane.

        Returns False, with all lanes in any state, where an environment does not give the same
        numbers again.
        """
        try:
            for lane, episode in enumerate(unpack(content)):
                seed = prepare(self.envs[lane], episode.began)
                self._begin(lane, **({} if seed is None else {"seed": seed, "options": None}))
                for action in episode.actions:
                    seen, reward, terminated, truncated = self._next(
                        self.envs[lane], self._asked(action)
                    )
                    if terminated or truncated:
                        return False
                    self._observations[lane] = seen
                    self._running[lane].note(seen, reward)
                if self._running[lane].check != episode.check:
                    return False
                self._running[lane] = episode
        except KeyboardInterrupt:
            raise
        except BaseException:  # an environment that has changed may raise anything
            return False
        self._resting[:] = False
        return True

    def _asked(self, action: np.ndarray) -> Any:
        """What a copy is asked to do: the action (A,), or the discrete one nearest to it.

        It is an array of its own, since an environment may write into it.
        """
        return action.copy() if self.discrete is None else self.nearest(action)

    def nearest(self, actions: np.ndarray) -> np.ndarray:
        """The discrete actions nearest to `actions` (..., 1) in [-1, 1], int64 (...)."""
        assert self.discrete is not None
        last = self.discrete - 1
        places = np.rint((actions[..., 0].astype(np.float64) + 1.0) / 2.0 * last).clip(0, last)
        return self._first_action + places.astype(np.int64)

    def _begin(self, lane: int, **arguments: Any) -> None:
        """Begin an episode in a lane."""
        env = self.envs[lane]
        self._running[lane] = Episode(beginning(env, arguments.get("seed")))
        self._observations[lane] = self._first(env, **arguments)
        self._running[lane].note(self._observations[lane])

    def _first(self, env: gymnasium.Env, **arguments: Any) -> np.ndarray:
        """The first observation (O,) of a new episode."""
        result = self._called("reset", env.reset, **arguments)
        if not isinstance(result, tuple) or len(result) != 2:
            self._broken("reset", result, "(observation, info)")
        return self._observation("reset", result[0])

    def _next(self, env: gymnasium.Env, action: Any) -> tuple[np.ndarray, float, bool, bool]:
        result = self._called("step", env.step, action)
        if not isinstance(result, tuple) or len(result) != 5:
            rule = "(observation, reward, terminated, truncated, info)"
            self._broken("step", result, rule)
        observation, reward, *ends, _ = result
        terminated, truncated = (self._single(end, "biu", result) for end in ends)
        gain = float(self._single(reward, "biuf", result))
        if not math.isfinite(gain):
            self._broken("step", gain, "a finite reward")
        return self._observation("step", observation), gain, bool(terminated), bool(truncated)

    def _single(self, value: Any, kinds: str, result: tuple) -> Any:
        """The one number in `value`, of one of numpy's `kinds`."""
        try:
            array = np.asarray(value)
        except (TypeError, ValueError):
            array = np.empty(0)
        if array.size != 1 or array.dtype.kind not in kinds:
            self._broken("step", result[1:4], "a number as reward, and two truth values")
        return array.item()

    def _called(self, name: str, function: Callable, *arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # a foreign environment may raise anything
            raise ConfigError(f"env.id={self.id} fails in {name}: {reason(error)}") from error

    def _observation(self, name: str, observation: Any) -> np.ndarray:
        try:
            with np.errstate(over="ignore"):  # beyond float32 is infinity
                array = np.array(observation, dtype=np.float32)  # a copy
        except (TypeError, ValueError):
            array = None
        shape = self.single_observation_space.shape
        if array is None or array.shape != shape:
            self._broken(name, observation, f"an observation of shape {shape}, as in its space")
        if np.isnan(array).any():
            self._broken(name, observation, "an observation of numbers, without NaN")
        return array

    def _broken(self, name: str, result: Any, rule: str) -> NoReturn:
        raise ConfigError(
            f"env.id={self.id} gives {_one_line(result)} in {name}: allowed is {rule}"
        )


def make_one(id: str, wrapped: Sequence[Wrap] = (), **kwargs: Any) -> gymnasium.Env:
    """One copy of an environment in its wrappers, the first of them innermost.

    Observations that are a Dict or a Tuple of numbers are laid end to end, as one flat Box.
    """
    with _without_hints():
        # The checker's warnings are meant for authors of environments.
        env = gymnasium.make(id, disable_env_checker=True, **kwargs)
    for wrap in wrapped:
        env = wrap(env)
    space = env.observation_space
    if isinstance(space, Dict | Tuple) and space.is_np_flattenable:
        env = FlattenObservation(env)
    return env


@contextmanager
def _without_hints() -> Iterator[None]:
    """Keep MuJoCo from writing hints about the model's file, once for each copy.

    They go to the screen and to a file in the working folder. Warnings about the physics come
    later, during steps, and are kept.
    """
    mujoco = sys.modules.get("mujoco")
    set_handler = getattr(mujoco, "set_mju_user_warning", None)
    if mujoco is None or set_handler is None:
        yield
        return
    before = mujoco.get_mju_user_warning()
    set_handler(lambda message: None)
    try:
        yield
    finally:
        set_handler(before)


def check_spaces(
    id: str, observation_space: gymnasium.Space, action_space: gymnasium.Space
) -> None:
    """Raise ConfigError unless both are flat Boxes of real numbers, and actions are bounded.

    Actions may also be discrete, two at least.
    """
    flat = isinstance(observation_space, Box) and len(observation_space.shape) == 1
    if not flat or not np.issubdtype(observation_space.dtype, np.floating):
        shown = _one_line(observation_space)
        raise ConfigError(
            f"env.id={id} observes {shown}: a one-dimensional Box of real numbers is allowed"
        )
    discrete = isinstance(action_space, Discrete) and action_space.n >= 2
    if not discrete and (not isinstance(action_space, Box) or len(action_space.shape) != 1):
        shown = _one_line(action_space)
        raise ConfigError(
            f"env.id={id} acts in {shown}: a one-dimensional, continuous Box is allowed, and a "
            "Discrete of two actions or more"
        )
    for does, space in (("observes", observation_space), ("acts in", action_space)):
        if space.shape == (0,):
            raise ConfigError(
                f"env.id={id} {does} {space}: a Box of at least one number is allowed"
            )
    if not isinstance(action_space, Box):
        return
    low, high = action_space.low.astype(np.float32), action_space.high.astype(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        finite = np.isfinite([low, high, high - low, high + low]).all()
        proper = finite and (high > low).all()
    if not np.issubdtype(action_space.dtype, np.floating) or not proper:
        shown = _one_line(action_space)
        raise ConfigError(
            f"env.id={id} acts in {shown}: a continuous Box with finite bounds is allowed"
        )


def _as_float32(space: Box) -> Box:
    with np.errstate(over="ignore"):
        low, high = space.low.astype(np.float32), space.high.astype(np.float32)
    return Box(low, high, dtype=np.float32)


def _one_line(value: Any) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 80 else text[:77] + "..."
