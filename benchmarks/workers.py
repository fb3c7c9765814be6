"""What is measured of this project. `measure.py` runs each worker in a process of its own.

    python benchmarks/workers.py WORKER '{"argument": value, ...}'

A worker is a function of this file. Its result is printed as one line of JSON.
"""

from __future__ import annotations

import itertools
import json
import multiprocessing
import resource
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

import train
from aser import build, envs, provenance
from aser.allocator import keep_memory
from aser.compiled import compiled
from aser.lanes import batched
from aser.noise import Stream
from aser.replay.buffer import Buffer
from aser.replay.sampler import Drawn
from aser.replay.storage import LANES_OF_MEMORY
from aser.training.learning import BLOCK
from aser.training.loop import Training
from aser.trees import tree_leaves

LANES = 16
STEPS, WARM = 1500, 400  # measured steps, and the steps before them
FIRST_UPDATE = 101  # the step of the first update; before it, actions are random
SETTLED = 620  # updates after which the threshold's quantile has risen to its highest
MAZE = ["env=maze", "hyper=thesis", "eval.every=null"]


def code() -> dict[str, str | None]:
    """The commit and the digest of the code that workers have."""
    return {"commit": provenance.commit(), "code": provenance.code_digest()}


def ours(
    overrides: Sequence[str], steps: int = STEPS, warm: int = WARM, full: bool = False
) -> dict[str, float]:
    """Speed in lane-steps per second, after `warm` steps past the first update.

    With `full`, the buffer is filled before. `peak_mib` is the largest memory of the process.
    `bytes_per_step` is what an update of one lane must move at least: its state is read and
    written, and the drawn rows are read.
    """
    training = make_training(overrides, steps + warm + FIRST_UPDATE)
    advance(training, FIRST_UPDATE)
    if full:
        fill(training.setup.buffer)
    advance(training, warm)
    seconds = elapsed(lambda: advance(training, steps))  # a step ends with its action on the CPU
    lanes, rows = len(training.setup.seeds), training.setup.buffer.storage.rows
    drawn_rows = training.setup.buffer.sampler.batch * rows.shape[2] * rows.element_size()
    return {
        "per_second": lanes * steps / seconds,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "bytes_per_step": 2 * nbytes(training.state) / lanes + drawn_rows,
    }


def in_turns(
    one: Sequence[str], other: Sequence[str], turns: int, steps: int = 200
) -> dict[str, list[float]]:
    """The time of a step of one training over that of another one: a ratio for each of the turns.

    Both are in this process and take turns of so many steps. The time is the processor's, so that
    other programs count for little.
    """
    trainings = [
        make_training(words, FIRST_UPDATE + SETTLED + turns * steps) for words in (one, other)
    ]
    for training in trainings:
        advance(training, FIRST_UPDATE + SETTLED)

    def seconds(training: Training) -> float:
        began = time.process_time()
        advance(training, steps)
        return time.process_time() - began

    ratios = []
    for _ in range(turns):
        above, below = (seconds(training) for training in trainings)
        ratios.append(above / below)
    return {"ratios": ratios}


@torch.no_grad()
def breakdown(overrides: Sequence[str]) -> dict[str, float]:
    """Microseconds of a step of all lanes and of its parts, each compiled and called alone."""
    training = make_training(overrides)
    advance(training, 600)
    setup, state, hyper, clock = training.setup, training.state, training.hyper, training._clock
    agent, buffer, update = setup.agent, setup.buffer, training._update
    sampler, memory, noise = buffer.sampler, buffer.memory(clock), training._numbers(training.step)
    action = training._actions[:, 0].numpy()  # (L, A)
    facts = {"obs": training._obs, "action": action, "next_obs": training._obs}
    facts |= dict.fromkeys(("reward", "terminated", "truncated"), action[:, 0] > 2)

    draw = compiled(buffer.draw)
    act = compiled(batched(lambda state, *rest: agent.act(state.agent, *rest)))
    assemble = compiled(batched(sampler.assemble, (0, LANES_OF_MEMORY, 0, 0, 0)))
    learn = compiled(batched(agent.update))
    judge = compiled(batched(sampler.mass_of_drawn, (0, LANES_OF_MEMORY, 0, 0, 0)))

    obs = torch.from_numpy(training._obs)[:, :, None]  # (L, O, 1)
    drawn = draw(noise[Stream.DRAW], hyper, clock, buffer.masses())
    batch, _ = assemble(state, memory, drawn, hyper, noise)
    mass = update.mass if sampler.rewrites else None
    parts: dict[str, Callable] = {
        "whole step": training.advance,
        "act": lambda: act(state, obs, hyper, noise),
        "environment": lambda: setup.envs.step(action),
        "store": lambda: buffer.append(facts, hyper),
        "draw": lambda: draw(noise[Stream.DRAW], hyper, clock, buffer.masses()),
        "gather and unroll": lambda: assemble(state, memory, drawn, hyper, noise),
        "update": lambda: learn(state.agent, batch, hyper, noise),
        "counts and priorities": lambda: buffer.write_back(
            drawn.index, update.n, update.measured, mass
        ),
    }
    if sampler.rewrites:
        parts["criterion of the drawn items"] = lambda: judge(
            state, memory, batch.obs, update.measured, hyper
        )
    costs = {part: best(function) for part, function in parts.items()}
    blocks = itertools.count()
    numbers = best(lambda: training._numbers(next(blocks) * BLOCK))  # a new block at each call
    return costs | {"random numbers (a block's share)": numbers / BLOCK}


@torch.no_grad()
def update_parts(overrides: Sequence[str]) -> dict[str, float]:
    """Microseconds of the parts of an update of all lanes.

    A compiled program leaves out what none of its results needs. So there is one for the targets,
    one for the critics too, and so on, and a part costs what it adds: the median of nine turns.
    """
    training = make_training(overrides)
    advance(training, 600)
    state, hyper, buffer = training.state, training.hyper, training.setup.buffer
    memory, noise = buffer.memory(training._clock), training._numbers(training.step)
    assemble = compiled(batched(buffer.sampler.assemble, (0, LANES_OF_MEMORY, 0, 0, 0)))
    draw = compiled(buffer.draw)
    drawn = draw(noise[Stream.DRAW], hyper, training._clock, buffer.masses())
    batch, _ = assemble(state, memory, drawn, hyper, noise)

    def program(shown: Callable) -> Callable:
        update = training.setup.agent.update
        part = compiled(batched(lambda *given: shown(*update(*given))))
        return lambda: part(state.agent, batch, hyper, noise)

    programs = {
        "targets": lambda _, info: info.target,
        "critics": lambda new, info: (info.target, new.critics, new.critics_moments),
        "actor": lambda new, info: (
            *(info.target, new.critics, new.critics_moments),
            *(new.actor, new.actor_moments),
        ),
        "temperature and target networks": lambda new, info: (new, info),
    }
    ready = [program(shown) for shown in programs.values()]
    turns = [[0.0, *(microseconds(one) for one in ready)] for _ in range(9)]
    added = np.median(np.diff(turns, axis=1), axis=0).tolist()
    return dict(zip(programs, added, strict=True))


def environments(overrides: Sequence[str], steps: int = 300, warm: int = 30) -> dict[str, float]:
    """Microseconds of a step of all lanes, and of the environments' part in it.

    The time is the processor's, of one thread, so that other programs count for nothing.
    """
    training = make_training(overrides)
    timed = Timed(training.setup.envs)
    training.setup = replace(training.setup, envs=timed)
    advance(training, FIRST_UPDATE + warm)
    timed.seconds, start = 0.0, time.process_time()
    advance(training, steps)
    whole = time.process_time() - start
    return {"step": 1e6 * whole / steps, "environments": 1e6 * timed.seconds / steps}


class Timed:
    """Environments, with the processor's time that their steps have taken."""

    def __init__(self, envs: VectorEnv):
        self.envs, self.seconds = envs, 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.envs, name)

    def step(self, actions: np.ndarray) -> Any:
        start = time.process_time()
        result = self.envs.step(actions)
        self.seconds += time.process_time() - start
        return result


def stepping(id: str, halves: bool, steps: int = 200) -> dict[str, float]:
    """Seconds of 16 environments' steps, and the processor's time that they take.

    With `halves`, this process steps one half of them and another process the other one.
    """
    lanes = LANES // 2 if halves else LANES
    mine = envs.make(id, lanes)
    space = mine.single_action_space
    shape = (steps, LANES, *space.shape)
    actions = np.random.default_rng(0).uniform(space.low, space.high, shape).astype(np.float32)
    mine.reset(seed=0)
    if not halves:
        start = time.process_time()
        seconds = elapsed(lambda: [mine.step(action) for action in actions])
        return {"seconds": seconds, "processor": time.process_time() - start}

    here, there = multiprocessing.Pipe()
    other = multiprocessing.Process(target=_half, args=(there, id, lanes), daemon=True)
    other.start()
    here.recv()

    def step(action: np.ndarray) -> None:
        here.send(action[lanes:])
        one = mine.step(action[:lanes])
        for pair in zip(one[:4], here.recv()[:4], strict=True):
            np.concatenate(pair)

    start = time.process_time()
    seconds = elapsed(lambda: [step(action) for action in actions])
    here.send(None)
    processor = time.process_time() - start + here.recv()
    other.join()
    return {"seconds": seconds, "processor": processor}


def _half(connection: Any, id: str, lanes: int) -> None:
    """Step so many environments for another process, and tell the processor's time at the end."""
    mine = envs.make(id, lanes)
    mine.reset(seed=LANES - lanes)
    connection.send("ready")
    start = time.process_time()
    while (actions := connection.recv()) is not None:
        connection.send(mine.step(actions))
    connection.send(time.process_time() - start)


@torch.no_grad()
def replay(overrides: Sequence[str]) -> dict[str, float]:
    """Microseconds of a step at a full buffer, of its draw and of writing priorities back.

    `bytes_per_item` counts the transition, its counters, and its priority with the nodes above it.
    """
    training = make_training(overrides)
    advance(training, FIRST_UPDATE + 50)
    buffer = training.setup.buffer
    fill(buffer)
    advance(training, 100)
    step = best(training.advance)

    draw = compiled(buffer.draw)
    numbers = [training._numbers(training.step + k)[Stream.DRAW].clone() for k in range(64)]

    def draw_all() -> list[Drawn]:
        hyper, clock, masses = training.hyper, training._clock, buffer.masses()
        return [draw(u, hyper, clock, masses) for u in numbers]

    indices = [drawn.index for drawn in draw_all()]  # items from everywhere in the buffer
    masses = [buffer.priorities.mass.gather(1, index) for index in indices]

    def write_all() -> None:
        for index, mass in zip(indices, masses, strict=True):
            buffer.priorities.write(index, mass)

    ones = torch.ones(LANES, dtype=torch.float64)
    drawing = microseconds(draw_all, 3) / len(numbers)
    writing = microseconds(write_all, 3) / len(numbers)
    writing += microseconds(lambda: buffer.priorities.append(7, ones))
    items = LANES * buffer.storage.capacity
    return {
        "step": step,
        "draw": drawing,
        "write": writing,
        "share": (drawing + writing) / step,
        "bytes_per_item": nbytes([vars(buffer.storage), vars(buffer.priorities)]) / items,
    }


def ceiling(hidden: Sequence[int], lanes: int = LANES, device: str = "cpu") -> dict[str, float]:
    """The best rate of batched matmuls in float32, and the bandwidth of a copy.

    The matmuls have the shapes of one update and count as often as the update does them.
    """
    torch.set_num_threads(1)

    def seconds_of(function: Callable, calls: int) -> float:
        def finished() -> None:
            function()
            if device == "cuda":
                torch.cuda.synchronize()

        return best(finished, calls) / 1e6

    seconds = 0.0
    for rows, inner, columns, times in update_matmuls(hidden):
        a = torch.randn(lanes, rows, inner, device=device)
        b = torch.randn(lanes, inner, columns, device=device)
        product = torch.empty(lanes, rows, columns, device=device)
        seconds += times * seconds_of(partial(torch.bmm, a, b, out=product), 30)
    source = torch.randn(64 * 2**20, device=device)
    target = torch.empty_like(source)
    copying = seconds_of(lambda: target.copy_(source), 3)
    return {
        "gflops": lanes * update_flops(hidden) / seconds / 1e9,
        "bandwidth": 2 * source.nbytes / copying / 1e9,  # read and written
    }


# How often the actor and the critics (there are two) go through each part of an update: forward,
# gradients of the weights, and gradients that go on to the network's input.
PASSES = {
    "targets": ((1, 0, 0), (2, 0, 0)),
    "critics": ((0, 0, 0), (2, 2, 0)),
    "actor": ((1, 1, 0), (2, 0, 2)),
}


def update_flops(
    hidden: Sequence[int], obs: int = 4, action: int = 2, parts: Sequence[str] = tuple(PASSES)
) -> float:
    """Floating-point operations of the matmuls of one update of one lane, or of parts of it."""
    return sum(
        2.0 * rows * inner * columns * times
        for rows, inner, columns, times in update_matmuls(hidden, obs, action, parts=parts)
    )


def update_matmuls(
    hidden: Sequence[int],
    obs: int = 4,
    action: int = 2,
    batch: int = 256,
    parts: Sequence[str] = tuple(PASSES),
) -> list[tuple[int, int, int, int]]:
    """(rows, inner, columns, how often) of the matmuls of one uniform SAC update of one lane."""
    networks = [obs, *hidden, 2 * action], [obs + action, *hidden, 1]
    shapes = []
    for sizes, *passes in zip(networks, *(PASSES[part] for part in parts), strict=True):
        forward, backward, to_input = np.sum(passes, 0).tolist()
        for depth, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
            shapes.append((outputs, inputs, batch, forward))
            shapes.append((outputs, batch, inputs, backward))  # gradient of the weights
            times = to_input + (backward if depth else 0)
            shapes.append((inputs, outputs, batch, times))  # gradient of the layer's input
    return [shape for shape in shapes if shape[3]]


def make_training(overrides: Sequence[str], steps: int = 5000) -> Training:
    """A training in the large maze, of at least 5,000 steps that all fit into the buffer.

    `overrides` are settings as on the command line, and come before these.
    """
    torch.set_num_threads(1)
    keep_memory()
    steps = max(steps, 5000)
    config = train.settings([*MAZE, f"steps={steps}", f"buffer={steps}", *overrides])
    return build.build(config, train.CONF, train.CONF.parent / "results")


@torch.no_grad()
def advance(training: Training, steps: int) -> None:
    for _ in range(steps):
        training.advance()


def fill(buffer: Buffer) -> None:
    """Repeat the stored transitions until the buffer is full."""
    storage, priorities = buffer.storage, buffer.priorities
    copies = torch.arange(storage.capacity) % storage.size
    storage.rows.copy_(storage.rows[:, copies])
    storage.stored = storage.capacity
    if priorities is not None:
        priorities.load_state_dict({"mass": priorities.mass[:, copies].clone()})


def nbytes(tree: Any) -> int:
    """Bytes of the tensors in a tree. Memory that two of them share counts once."""
    memory = [leaf.untyped_storage() for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]
    return sum({part.data_ptr(): part.nbytes() for part in memory}.values())


def best(function: Callable, calls: int = 200) -> float:
    """Microseconds of one call, the lowest of three means."""
    return min(microseconds(function, calls) for _ in range(3))


def microseconds(function: Callable, calls: int = 200) -> float:
    """Mean microseconds of one call, after a first call that is not counted."""
    function()
    return 1e6 * elapsed(lambda: [function() for _ in range(calls)]) / calls


def elapsed(function: Callable) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


if __name__ == "__main__":
    worker, arguments = sys.argv[1:]
    print(json.dumps(globals()[worker](**json.loads(arguments))))
