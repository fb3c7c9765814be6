"""The loop: act, step, store, learn; all lanes in lock-step, one gradient update per environment step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from types import ModuleType
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from aser import checkpoint, noise
from aser.lanes import batched
from aser.noise import Stream
from aser.replay import priorities
from aser.replay.buffer import Buffer
from aser.replay.criteria import Criterion
from aser.training import diagnostics
from aser.training.diagnostics import Frozen
from aser.training.evaluation import Evaluation, action_scaling
from aser.training.learning import Supply, learner

STEADY = 200  # updates after which the speed is measured


@dataclass
class Setup:
    """What a run is made of; `build` puts it together. L lanes."""

    agent: ModuleType  # sac, dqn
    state: Any  # the agents' fresh states, every leaf (L, ...)
    buffer: Buffer
    envs: VectorEnv
    evaluation: Evaluation | None
    hyper: dict[str, Tensor]  # each (L,)
    seeds: list[int]
    steps: int
    learning_starts: int
    eval_every: int  # how often to evaluate, and to note diagnostics
    compile: bool = True
    td_error: str = "min"
    frozen: dict[str, Frozen] = field(default_factory=dict)  # by the name of the criterion


@dataclass
class History:
    """What was measured so far: returns (L,) and diagnostics (L,) each at a step."""

    returns: list[tuple[int, np.ndarray]] = field(default_factory=list)
    diagnostics: list[tuple[int, dict[str, np.ndarray]]] = field(default_factory=list)
    diverged: dict[int, int] = field(default_factory=dict)  # lane -> step at which it was noticed


class Training:
    """A run in progress. `run` takes it to its end; `state_dict` holds all that its future depends on."""

    def __init__(self, setup: Setup):
        self.setup = setup
        self.state = setup.state
        self.step = 0
        self.history = History()
        self.steady_seconds, self.steady_steps = 0.0, 0
        self.device = setup.buffer.keys.device
        self._to_env = action_scaling(setup.envs)
        oracle = getattr(setup.envs, "oracle", None)
        self._roc_auc = diagnostics.criterion_auc(setup.buffer.sampler, oracle, setup.frozen)
        self._learn = learner(setup.agent, setup.buffer, setup.td_error, setup.compile)
        self._numbers = Supply(setup.agent, setup.buffer, setup.compile)
        self._obs, _ = setup.envs.reset(seed=list(setup.seeds))  # type: ignore[arg-type]
        self._actions = torch.from_numpy(self._warm_up_actions())  # (L, S, A), then (L, 1, A)

    @torch.no_grad()
    def run(
        self,
        after_step: Callable[[Training], bool] = lambda _: False,
        after_evaluation: Callable = lambda _: None,
    ) -> bool:
        """Train to the end; False if `after_step` asked to stop before. Neither callback may change the training."""
        setup = self.setup
        while self.step < setup.steps:
            began = perf_counter()
            self.advance()
            if self.step > setup.learning_starts + STEADY:
                self.steady_seconds += perf_counter() - began
                self.steady_steps += 1
            if self.step % setup.eval_every == 0 or self.step == setup.steps:
                self._evaluate()
                after_evaluation(self)
            if after_step(self):
                return False
        return True

    def advance(self) -> None:
        """One environment step of every lane, and one update once learning has started."""
        setup = self.setup
        action = self._next_action()
        obs = self._obs
        self._obs, reward, terminated, truncated, info = setup.envs.step(
            self._to_env(action.numpy())
        )
        next_obs = self._obs
        if "final_obs" in info:
            ended = info["_final_obs"]
            next_obs = self._obs.copy()
            next_obs[ended] = np.stack(list(info["final_obs"][ended]))
        self._store(obs, action, reward, next_obs, terminated, truncated)
        self.step += 1
        if self.step > setup.learning_starts:
            self._clock = setup.buffer.storage.clock(self.step, setup.steps)
            now = torch.from_numpy(self._obs).to(self.device)
            numbers = self._numbers(self.step)
            self.state, action, self._outcome = self._learn(
                self.state, now, setup.hyper, self._clock, numbers
            )
            self._actions = action.cpu()[:, None]

    def state_dict(self) -> dict:
        """Tensors, arrays and builtins only."""
        envs = self.setup.envs
        return {
            "step": self.step,
            "agent": checkpoint.leaves(self.state),
            "buffer": self.setup.buffer.state_dict(),
            "actions": self._actions,
            "environment": envs.state_dict() if envs.state_dict else None,  # type: ignore[attr-defined]
            "returns": [list(pair) for pair in self.history.returns],
            "diagnostics": [list(pair) for pair in self.history.diagnostics],
            "diverged": self.history.diverged,
            "steady": [self.steady_seconds, self.steady_steps],
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from where `state_dict` was called; environments that keep no state begin their episode again."""
        self.step = state["step"]
        self.state = checkpoint.rebuild(state["agent"], self.state)
        self.setup.buffer.load_state_dict(state["buffer"])
        self._actions = state["actions"]
        envs = self.setup.envs
        if state["environment"] is not None:
            envs.load_state_dict({k: v.cpu().numpy() for k, v in state["environment"].items()})  # type: ignore
            self._obs = envs.observations()  # type: ignore[attr-defined]
        else:
            self.setup.buffer.storage.end_episode()
        returns = [(step, values.cpu().numpy()) for step, values in state["returns"]]
        notes = [
            (step, {k: v.cpu().numpy() for k, v in values.items()})
            for step, values in state["diagnostics"]
        ]
        self.history = History(returns, notes, dict(state["diverged"]))
        self.steady_seconds, self.steady_steps = state["steady"]

    def _next_action(self) -> Tensor:
        if self.step < self.setup.learning_starts:
            return self._actions[:, self.step]
        if (
            self.step == self.setup.learning_starts
        ):  # from here on, each update also gives the next action
            obs = torch.from_numpy(self._obs).to(self.device)
            act = batched(self.setup.agent.act)
            self._actions = (
                act(self.state, obs[:, :, None], self.setup.hyper, self._numbers(self.step))
                .cpu()
                .mT
            )
        return self._actions[:, 0]

    def _warm_up_actions(self) -> np.ndarray:
        """Uniform random actions (L, S, A)."""
        shape = (self.setup.learning_starts, self.setup.envs.single_action_space.shape[0])  # type: ignore[index]
        draw = batched(
            lambda state, key: self.setup.agent.at_random(state, noise.uniform(key, shape))
        )
        return draw(self.state, self.setup.buffer.keys[:, Stream.WARM_UP].cpu()).numpy()

    def _store(
        self, obs: np.ndarray, action: Tensor, reward: Any, next_obs: np.ndarray, *ends: np.ndarray
    ) -> None:
        setup = self.setup
        facts = {"obs": obs, "action": action, "reward": reward, "next_obs": next_obs}
        facts |= dict(zip(("terminated", "truncated"), ends, strict=True))
        mass = None
        sampler = setup.buffer.sampler
        if sampler.prioritised and sampler.drawing.known == "arrival":
            p = self._at_arrival(sampler.drawing, obs)
            mass = priorities.mass(p, setup.hyper["alpha"], setup.hyper["epsilon"])
        if "p_next" in sampler.layout.columns:
            facts["p_next"] = self._at_arrival(sampler.stopping, next_obs).cpu()
        setup.buffer.append(facts, mass)

    def _at_arrival(self, criterion: Criterion, obs: np.ndarray) -> Tensor:
        """p (L,) of a frozen criterion at observations (L, O)."""
        return self.setup.frozen[criterion.key](torch.from_numpy(obs)[..., None].to(self.device))[
            :, 0
        ]

    def _evaluate(self) -> None:
        setup = self.setup
        for lane in np.flatnonzero(~finite(self.state)):
            self.history.diverged.setdefault(int(lane), self.step)
        if self.step > setup.learning_starts:
            info, n, b, index = self._outcome
            values = diagnostics.of_update(info, n, b, index, setup.buffer, self._clock)
            values["roc_auc"] = self._roc_auc(self.state, setup.buffer, self._clock)
            self.history.diagnostics.append((self.step, values))
        if setup.evaluation is not None:
            returns = setup.evaluation(self.state)
            returns[list(self.history.diverged)] = self._worst_return(returns)
            self.history.returns.append((self.step, returns))

    def _worst_return(self, returns: np.ndarray) -> float:
        """What a diverged lane counts as: the environment's worst return or, if unknown, the lowest ever seen."""
        worst = getattr(self.setup.envs, "worst_return", None)
        seen = [values.min() for _, values in self.history.returns] + [returns.min()]
        return float(min(seen)) if worst is None else worst


def finite(state: Any) -> np.ndarray:
    """Which lanes' numbers are all finite, (L,)."""
    lanes = [leaf.reshape(len(leaf), -1).isfinite().all(1) for leaf in checkpoint.leaves(state)]
    return torch.stack(lanes).all(0).cpu().numpy()
