"""The loop: act, step, store, learn. All lanes advance in lock-step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from aser import checkpoint, noise
from aser.agents import Agent
from aser.compiled import compiled
from aser.lanes import batched
from aser.noise import Stream
from aser.replay import correction
from aser.replay.buffer import Buffer
from aser.replay.sampler import State
from aser.training import diagnostics
from aser.training.evaluation import Evaluation, action_scaling
from aser.training.learning import Part, Supply, learner
from aser.trees import contiguous, named

STEADY = 200  # updates after which the speed is measured


@dataclass(frozen=True)
class Setup:
    """What a run is made of; `build` puts it together. L lanes."""

    agent: Agent
    state: State  # fresh, every leaf (L, ...)
    buffer: Buffer
    envs: VectorEnv
    evaluation: Evaluation | None
    hyper: dict[str, Tensor]  # each (L,)
    seeds: list[int]
    steps: int
    learning_starts: int
    eval_every: int  # steps between evaluations, and between diagnostics
    compile: bool = True
    td_error: str = "min"  # how two critics' TD errors become one
    updates: int = 1  # for each environment step
    before: Sequence[Part] = ()  # parts of each update before that of the agent and the sampler


@dataclass
class History:
    """What was measured so far: returns (L,) and diagnostics (L,) each at a step."""

    returns: list[tuple[int, np.ndarray]] = field(default_factory=list)
    diagnostics: list[tuple[int, dict[str, np.ndarray]]] = field(default_factory=list)
    diverged: dict[int, int] = field(default_factory=dict)  # lane -> step at which it was noticed


class Training:
    """A run in progress. `state_dict` holds all that its future depends on."""

    def __init__(self, setup: Setup):
        self.setup, self.hyper, self.state = setup, setup.hyper, setup.state
        self.step, self.keeps_episodes = 0, True
        self.history = History()
        self.steady_seconds, self.steady_steps = 0.0, 0
        self.device = setup.buffer.keys.device
        self._to_env = action_scaling(setup.envs)
        oracle = getattr(setup.envs, "oracle", None)
        self._roc_auc = diagnostics.criterion_auc(setup.buffer.sampler, oracle)
        parts = [*setup.before, Part(setup.agent, setup.buffer.sampler)]
        self._learn = learner(parts, setup.buffer, setup.td_error, setup.compile)
        keys = setup.buffer.keys
        self._supplies = [
            Supply(part, noise.branch(keys, place), setup.compile)
            for place, part in enumerate(setup.before)
        ]
        self._numbers = Supply(parts[-1], keys, setup.compile)
        self._obs, _ = setup.envs.reset(seed=list(setup.seeds))  # type: ignore[arg-type]
        self._actions = torch.from_numpy(self._warm_up_actions())  # (L, S, A), then (L, 1, A)
        self._density = compiled(batched(partial(correction.log_mu, setup.agent)), setup.compile)

    @torch.no_grad()
    def run(
        self,
        after_step: Callable[[Training], bool] = lambda _: False,
        after_evaluation: Callable = lambda _: None,
        poll: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Train to the end. Returns False if `after_step` or `poll` asked to stop before.

        `poll` is also called at each step of an evaluation. An evaluation that was cut off is
        repeated by the next call. No callback may change the training.
        """
        setup = self.setup
        cut_off = self._lacks_evaluation() and self.step > 0
        if not self._evaluate(after_evaluation, poll):
            return False
        if cut_off and after_step(self):  # what follows this step was not done either
            return False
        while self.step < setup.steps:
            began = perf_counter()
            self.advance()
            if self.step > setup.learning_starts + STEADY:
                self.steady_seconds += perf_counter() - began
                self.steady_steps += 1
            self._look()
            if not self._evaluate(after_evaluation, poll):
                return False
            if after_step(self) or poll():
                return False
        return True

    def advance(self) -> None:
        """One environment step of every lane, and its updates once learning has started."""
        setup = self.setup
        action = self._next_action()
        obs, facts = self._obs, self._further_facts(action)
        self._obs, reward, terminated, truncated, info = setup.envs.step(
            self._to_env(action.numpy())
        )
        next_obs = self._obs
        if "final_obs" in info:
            ended = info["_final_obs"]
            next_obs = self._obs.copy()
            next_obs[ended] = np.stack(list(info["final_obs"][ended]))
        facts |= {"obs": obs, "action": action.numpy(), "reward": reward, "next_obs": next_obs}
        facts |= {"terminated": terminated, "truncated": truncated}
        setup.buffer.append(facts, self.hyper)
        self.step += 1
        if self.step > setup.learning_starts:
            self._clock = setup.buffer.storage.clock(self.step, setup.steps)
            now = torch.from_numpy(self._obs).to(self.device)
            for update in range(1, setup.updates + 1):
                number = (self.step - 1) * setup.updates + update
                numbers = [supply(number) for supply in (*self._supplies, self._numbers)]
                self._drawn, self._update = self._learn(
                    self.state, now, self.hyper, self._clock, numbers
                )
                self.state = self._update.state
            self._actions = self._update.action.cpu()[:, None]

    @property
    def sizes(self) -> dict[str, int]:
        """The numbers of an observation and of an action."""
        layout = self.setup.buffer.sampler.layout
        return {"obs": layout.obs_dim, "action": layout.action_dim}

    def state_dict(self) -> dict:
        """Tensors, arrays and builtins only."""
        envs: Any = self.setup.envs
        return {
            "step": self.step,
            "agent": checkpoint.leaves(self.state.agent),
            "names": [name for name, _ in named(self.state.agent)],  # for readers of the file
            "criteria": checkpoint.leaves(self.state.criteria),
            "buffer": self.setup.buffer.state_dict(),
            "actions": self._actions,
            "environment": envs.state_dict() if envs.state_dict else None,
            "episodes": None if envs.state_dict else envs.episodes(),
            "returns": [list(pair) for pair in self.history.returns],
            "diagnostics": [list(pair) for pair in self.history.diagnostics],
            "diverged": self.history.diverged,
            "steady": [self.steady_seconds, self.steady_steps],
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from where `state_dict` was called.

        Environments that save no state play their episodes again. Where they do not give the same
        numbers, new episodes begin, and `keeps_episodes` is False.
        """
        self.step = state["step"]
        agent, criteria = self.state
        agent = checkpoint.rebuild(state["agent"], agent)
        # What was saved stays as it is, though criteria may write into their tables.
        self.state = State(agent, contiguous(checkpoint.rebuild(state["criteria"], criteria)))
        self.setup.buffer.load_state_dict(state["buffer"])
        self._actions = state["actions"].cpu()
        envs: Any = self.setup.envs
        episodes = state.get("episodes")  # older checkpoints have none
        if episodes is not None:
            acted = [torch.as_tensor(actions).cpu() for actions in episodes["actions"]]
            episodes = {**episodes, "actions": acted}
        self.keeps_episodes = True
        if state["environment"] is not None:
            envs.load_state_dict({k: v.cpu().numpy() for k, v in state["environment"].items()})
            self._obs = envs.observations()
        elif episodes is not None and envs.play(episodes):
            self._obs = envs.observations()
        else:
            self.keeps_episodes = False
            self._obs, _ = envs.reset(seed=list(self.setup.seeds))
            self.setup.buffer.storage.end_episode()
        returns = [(step, values.cpu().numpy()) for step, values in state["returns"]]
        notes = [
            (step, {k: v.cpu().numpy() for k, v in values.items()})
            for step, values in state["diagnostics"]
        ]
        self.history = History(returns, notes, dict(state["diverged"]))
        self.steady_seconds, self.steady_steps = state["steady"]

    def begin_again(self, start: dict, hyper: dict[str, Tensor]) -> None:
        """Go back to `start`, given by `state_dict`, with other hyper-parameters, each (L,)."""
        self.load_state_dict(start)
        self.hyper = hyper

    def _next_action(self) -> Tensor:
        if self.step < self.setup.learning_starts:
            return self._actions[:, self.step]
        if self.step == self.setup.learning_starts:
            # The first action of the agent; from here on each update also gives the next action.
            obs = torch.from_numpy(self._obs).to(self.device)[:, :, None]  # (L, O, 1)
            act = batched(self.setup.agent.act)
            numbers = self._numbers(self.step * self.setup.updates)
            self._actions = act(self.state.agent, obs, self.hyper, numbers).cpu().mT  # (L, 1, A)
        return self._actions[:, 0]

    def _further_facts(self, action: Tensor) -> dict[str, np.ndarray]:
        """log mu (L,) of the actions (L, A), where the sampler corrects by it."""
        columns = self.setup.buffer.sampler.layout.columns
        if correction.COLUMN not in columns:
            return {}
        log_mu = np.full(len(action), correction.log_uniform(action.shape[1]), np.float32)
        if self.step >= self.setup.learning_starts:
            obs = torch.from_numpy(self._obs).to(self.device)[:, :, None]  # (L, O, 1)
            taken = action.to(self.device)[:, :, None]  # (L, A, 1)
            log_mu = self._density(self.state.agent, obs, taken)[:, 0].cpu().numpy()
        return {correction.COLUMN: log_mu}

    def _warm_up_actions(self) -> np.ndarray:
        """Uniform random actions (L, S, A)."""
        shape = (self.setup.learning_starts, self.setup.envs.single_action_space.shape[0])  # type: ignore[index]
        draw = batched(
            lambda state, key: self.setup.agent.at_random(state, noise.uniform(key, shape))
        )
        return draw(self.state.agent, self.setup.buffer.keys[:, Stream.WARM_UP].cpu()).numpy()

    def _due(self) -> bool:
        """Whether diagnostics and an evaluation belong to the present step."""
        step = self.step
        return step > 0 and (step % self.setup.eval_every == 0 or step == self.setup.steps)

    def _look(self) -> None:
        """Note which lanes have diverged, and the diagnostics of the last update."""
        if not self._due():
            return
        self.setup.buffer.check()
        for lane in np.flatnonzero(~finite(self.state.agent)):
            self.history.diverged.setdefault(int(lane), self.step)
        if self.step > self.setup.learning_starts:
            buffer = self.setup.buffer
            values = diagnostics.of_update(
                self._update, self._drawn, buffer, self._clock, self.hyper
            )
            values["roc_auc"] = self._roc_auc(self.state, buffer, self._clock)
            self.history.diagnostics.append((self.step, values))

    def _evaluate(self, after_evaluation: Callable, poll: Callable[[], bool]) -> bool:
        """Evaluate where that is due and not done. Returns False if `poll` asked to stop."""
        evaluation, returns = self.setup.evaluation, self.history.returns
        if not self._lacks_evaluation():
            return True
        if evaluation is not None:
            values = evaluation(self.state.agent, poll)
            if values is None:
                return False
            values[list(self.history.diverged)] = self._worst_return(values)
            returns.append((self.step, values))
        after_evaluation(self)
        return True

    def _lacks_evaluation(self) -> bool:
        """Whether an evaluation is due at this step and not done."""
        returns = self.history.returns
        return self._due() and not (returns and returns[-1][0] == self.step)

    def _worst_return(self, returns: np.ndarray) -> float:
        """What a diverged lane counts as: the worst return or, where unknown, the lowest seen.

        NaN, which an environment of one's own may give, is not lower than anything.
        """
        worst = getattr(self.setup.envs, "worst_return", None)
        if worst is not None:
            return worst
        seen = np.concatenate([*(values for _, values in self.history.returns), returns])
        return float(np.fmin.reduce(seen))


def finite(state: Any) -> np.ndarray:
    """Which lanes' numbers are all finite, (L,)."""
    lanes = [leaf.reshape(len(leaf), -1).isfinite().all(1) for leaf in checkpoint.leaves(state)]
    return torch.stack(lanes).all(0).cpu().numpy()
