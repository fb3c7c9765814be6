"""What benchmarks/measure.py measures: each worker is a process of its own with one thread, and prints a line of JSON.

python benchmarks/workers.py WORKER '{"argument": value, ...}'
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

LANES, STEPS, WARM = 16, 1500, 400  # lanes of ours; measured steps; steps before the clock starts
MAZE = ["env=maze", "hyper=thesis", "eval.every=null"]


def main(worker: str, arguments: str) -> None:
    print(json.dumps(WORKERS[worker](**json.loads(arguments))))


def build(overrides: Sequence[str], steps: int) -> Any:
    import torch

    torch.set_num_threads(1)
    import train
    from aser.allocator import keep_memory
    from aser.build import build as make

    keep_memory()

    sized = any(o.startswith("buffer=") for o in overrides)
    buffer = [] if sized else [f"buffer={max(steps, 5000)}"]
    return make(
        train.settings([*MAZE, f"steps={max(steps, 5000)}", *buffer, *overrides]), train.CONF
    )


def ours(
    overrides: Sequence[str], steps: int = STEPS, warm: int = WARM, full: bool = False
) -> dict:
    """Lane-steps per second after `warm` steps past the first update; `full` starts with a filled buffer."""
    import torch

    from aser import checkpoint

    training = build(overrides, steps + warm + 101)
    with torch.no_grad():
        for _ in range(101):
            training.advance()
        if full:
            fill(training)
        for _ in range(warm):
            training.advance()
        seconds = elapsed(
            lambda: [training.advance() for _ in range(steps)]
        )  # each ends with an action on the CPU
    lanes = len(training.setup.seeds)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    # What a lane's update cannot do without: its state read and written, and the drawn rows read.
    state = (
        sum(leaf.numel() * leaf.element_size() for leaf in checkpoint.leaves(training.state))
        / lanes
    )
    moved = (
        2 * state
        + training.setup.buffer.sampler.batch * training.setup.buffer.storage.rows.shape[2] * 4
    )
    return {"per_second": lanes * steps / seconds, "peak_mib": peak, "bytes_per_step": moved}


def fill(training: Any) -> None:
    """Repeat the stored transitions until the ring is full."""
    import torch

    buffer = training.setup.buffer
    storage, known = buffer.storage, buffer.storage.size
    copies = torch.arange(storage.capacity) % known
    storage.rows.copy_(storage.rows[:, copies])
    storage.stored = storage.capacity
    if buffer.priorities is not None:
        mass = buffer.priorities.mass[:, copies].clone()
        buffer.priorities.load_state_dict({"mass": mass})


def first_step(overrides: Sequence[str]) -> dict:
    """Seconds from the start of the interpreter to the first update."""
    import torch

    training = build(overrides, 5000)
    with torch.no_grad():
        for _ in range(101):
            training.advance()
    return {"seconds": time.time() - float(os.environ["BENCHMARK_STARTED"])}


def breakdown(overrides: Sequence[str]) -> dict[str, float]:
    """Microseconds of one step of all lanes, and of its parts."""
    import torch

    from aser.compiled import compiled
    from aser.lanes import batched
    from aser.noise import Stream
    from aser.training.learning import BLOCK

    training = build(overrides, 5000)
    setup, buffer, agent = training.setup, training.setup.buffer, training.setup.agent
    sampler = buffer.sampler
    with torch.no_grad():
        for _ in range(600):
            training.advance()
        state, hyper, clock, noise = (
            training.state,
            setup.hyper,
            training._clock,
            training._numbers(training.step),
        )
        obs, action, memory = (
            torch.from_numpy(training._obs),
            training._actions[:, 0].numpy(),
            buffer.memory(),
        )
        index, weight = buffer.draw(noise[Stream.DRAW], hyper, clock)

        def assembled(state, memory, index, weight, hyper, clock, noise):
            return sampler.assemble(
                state, agent.temperature(state), memory, index, weight, hyper, clock, noise
            )

        draw = compiled(
            lambda noise, hyper, clock, masses: buffer.draw(
                noise[Stream.DRAW], hyper, clock, masses
            )
        )
        gather = compiled(batched(assembled, (0, 0, 0, 0, 0, None, 0)))
        batch, n, _ = gather(state, memory, index, weight, hyper, clock, noise)
        update = compiled(batched(agent.update))
        act = compiled(
            batched(lambda state, obs, hyper, noise: agent.act(state, obs[:, None], hyper, noise))
        )
        mass = None if buffer.priorities is None else buffer.priorities.mass.gather(1, index)
        ends = {"terminated": action[:, 0] > 2, "truncated": action[:, 0] > 2}
        facts = {
            "obs": training._obs,
            "action": action,
            "reward": action[:, 0],
            "next_obs": training._obs,
        } | ends
        parts = {
            "whole step": training.advance,
            "act": lambda: act(state, obs, hyper, noise),
            "environment": lambda: setup.envs.step(action),
            "store": lambda: buffer.append(facts),
            "random numbers (a block's share)": lambda: training._numbers._make(
                training._numbers._stepped
            ),
            "draw": lambda: draw(noise, hyper, clock, buffer.masses()),
            "gather and unroll": lambda: gather(state, memory, index, weight, hyper, clock, noise),
            "update": lambda: update(state, batch, hyper, noise),
            "counts and priorities": lambda: buffer.write_back(index, n, mass, weight),
        }
        if sampler.prioritised and sampler.drawing.known == "now":
            judge = compiled(batched(lambda *args: sampler.priority(*args)))
            parts["criterion of the drawn items"] = lambda: judge(
                state, batch.obs, weight, memory, hyper
            )
        found = {name: min(micro(part) for _ in range(3)) for name, part in parts.items()}
    found["random numbers (a block's share)"] /= BLOCK
    return found


def replay(overrides: Sequence[str]) -> dict[str, float]:
    """Microseconds of a step at a full buffer, of its draw and of writing priorities back; bytes of one item."""
    import torch

    from aser.compiled import compiled
    from aser.noise import Stream

    training = build(overrides, 5000)
    buffer, hyper = training.setup.buffer, training.setup.hyper
    with torch.no_grad():
        for _ in range(150):
            training.advance()
        fill(training)
        for _ in range(100):
            training.advance()
        step = min(micro(training.advance) for _ in range(3))
        numbers = [training._numbers(training.step + k)[Stream.DRAW].clone() for k in range(64)]
        draw = compiled(lambda u, hyper, clock, masses: buffer.draw(u, hyper, clock, masses))
        drawn = [
            draw(u, hyper, training._clock, buffer.masses())[0] for u in numbers
        ]  # everywhere in the buffer
        masses = [buffer.priorities.mass.gather(1, index) for index in drawn]
        draws = micro(
            lambda: [draw(u, hyper, training._clock, buffer.masses()) for u in numbers], 3
        ) / len(numbers)
        pairs = list(zip(drawn, masses, strict=True))
        writes = micro(lambda: [buffer.priorities.write(*pair) for pair in pairs], 3) / len(pairs)
        ready = torch.ones(LANES, dtype=torch.float64)
        writes += micro(lambda: buffer.priorities.append(7, ready))
    kept = [
        buffer.storage.rows,
        buffer.storage.draw_count,
        buffer.storage.unroll_sum,
        buffer.priorities.leaves,
    ]
    for levels in (
        getattr(buffer.priorities, name, [None])[1:] for name in ("sums", "most", "least")
    ):
        kept += levels
    size = (
        sum(tensor.numel() * tensor.element_size() for tensor in kept)
        / LANES
        / buffer.storage.capacity
    )
    return {
        "step": step,
        "draw": draws,
        "write": writes,
        "share": (draws + writes) / step,
        "bytes_per_item": size,
    }


def sb3_bytes() -> dict:
    """Bytes of one item in Stable Baselines3's replay buffer."""
    buffer = peer("stable_baselines3", seed=0, total=5000).replay_buffer
    return {
        "bytes_per_item": sum(v.nbytes for v in vars(buffer).values() if hasattr(v, "nbytes"))
        / 5000
    }


def ceiling(hidden: Sequence[int], lanes: int = LANES, device: str = "cpu") -> dict:
    """Best batched fp32 matmul rate, weighted as the update's matmuls are, and the bandwidth of a copy."""
    import torch

    torch.set_num_threads(1)

    def micro_of(function: Callable, times: int) -> float:
        def waited() -> None:
            function()
            if device == "cuda":
                torch.cuda.synchronize()

        return min(micro(waited, times) for _ in range(3))

    seconds, flops = 0.0, 0.0
    for rows, inner, columns, times in update_matmuls(hidden):
        a, b = (
            torch.randn(lanes, rows, inner, device=device),
            torch.randn(lanes, inner, columns, device=device),
        )
        out = torch.empty(lanes, rows, columns, device=device)
        seconds += times * micro_of(lambda a=a, b=b, out=out: torch.bmm(a, b, out=out), 30) / 1e6
        flops += times * 2.0 * lanes * rows * inner * columns
    source = torch.randn(64 * 2**20, device=device)
    target = torch.empty_like(source)
    copied = micro_of(lambda: target.copy_(source), 3) / 1e6
    return {"gflops": flops / seconds / 1e9, "bandwidth": 2.0 * source.numel() * 4 / copied / 1e9}


def update_matmuls(
    hidden: Sequence[int], obs: int = 4, action: int = 2, batch: int = 256
) -> list[tuple]:
    """(rows, inner, columns, how often) of the matmuls of one uniform SAC update of one lane."""
    actor, critic = [obs, *hidden, 2 * action], [obs + action, *hidden, 1]
    found = []
    for sizes, forward, backward, to_input in ((actor, 2, 1, 0), (critic, 6, 2, 2)):
        for depth, (inputs, outputs) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
            found.append((outputs, inputs, batch, forward))
            found.append((outputs, batch, inputs, backward))  # gradient of the weights
            found.append(
                (inputs, outputs, batch, (backward if depth else 0) + to_input)
            )  # and of the inputs
    return [(*shape, times) for *shape, times in found if times]


def update_flops(hidden: Sequence[int]) -> float:
    return sum(2.0 * a * b * c * times for a, b, c, times in update_matmuls(hidden))


def sb3(seconds: float = 6.0) -> dict:
    """Steps per second of Stable Baselines3's SAC once learning has started."""
    return peer_speed(peer("stable_baselines3", seed=0, total=10**6), seconds)


def sbx(seconds: float = 6.0) -> dict:
    """The same of SBX's, after JAX has compiled."""
    return peer_speed(peer("sbx", seed=0, total=10**6), seconds)


def sb3_dqn(seconds: float = 6.0) -> dict:
    """The same of Stable Baselines3's DQN in the corridor, among 21 actions, with an update after every step."""
    import gymnasium
    import numpy as np
    import torch
    from gymnasium.wrappers import TransformAction
    from stable_baselines3 import DQN

    import aser.envs  # noqa: F401  (registers the corridor)

    torch.set_num_threads(1)
    grid = np.linspace(-1.0, 1.0, 21, dtype=np.float32)
    env = TransformAction(
        gymnasium.make("aser/Corridor-v0"), lambda k: grid[[k]], gymnasium.spaces.Discrete(21)
    )
    model = DQN(
        "MlpPolicy",
        env,
        policy_kwargs={"net_arch": [24]},
        buffer_size=5000,
        batch_size=256,
        train_freq=1,
        learning_starts=100,
        target_update_interval=200,
        seed=0,
    )
    return peer_speed(model, seconds)


def peer_speed(model: Any, seconds: float) -> dict:
    clock: dict[str, float] = {}

    def note(local: dict, _: dict) -> bool:
        steps, now = local["self"].num_timesteps, time.perf_counter()
        if steps == 101 + WARM:
            clock["from"], clock["start"] = steps, now
        if "start" in clock and now - clock["start"] > seconds:
            clock["per_second"] = (steps - clock["from"]) / (now - clock["start"])
            return False
        return True

    model.learn(10**6, callback=note)
    return {"per_second": clock["per_second"]}


def peer(package: str, seed: int, total: int) -> Any:
    import importlib

    import gymnasium
    import torch

    import aser.envs  # noqa: F401  (registers the maze)

    torch.set_num_threads(1)
    sac = importlib.import_module(package).SAC
    buffer = min(total, 5000)
    policy = {"net_arch": [24]}
    return sac(
        "MlpPolicy",
        gymnasium.make("aser/Maze-v0"),
        policy_kwargs=policy,
        buffer_size=buffer,
        seed=seed,
    )


def sb3_process(seed: int) -> dict:
    """Seconds of one whole run of 5,000 steps with an evaluation every 100, the interpreter's start included."""
    import gymnasium
    from stable_baselines3.common.callbacks import EvalCallback
    from stable_baselines3.common.monitor import Monitor

    model = peer("stable_baselines3", seed, 5000)
    judge = EvalCallback(
        Monitor(gymnasium.make("aser/Maze-v0")), n_eval_episodes=1, eval_freq=100, verbose=0
    )
    model.learn(5000, callback=judge)
    return {"seconds": time.time() - float(os.environ["BENCHMARK_STARTED"])}


def elapsed(function: Callable) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def micro(function: Callable, times: int = 200) -> float:
    """Microseconds of one call."""
    function()
    return 1e6 * elapsed(lambda: [function() for _ in range(times)]) / times


WORKERS: dict[str, Callable[..., dict]] = {
    f.__name__: f
    for f in (
        ours,
        first_step,
        breakdown,
        replay,
        ceiling,
        sb3,
        sbx,
        sb3_dqn,
        sb3_bytes,
        sb3_process,
    )
}


if __name__ == "__main__":
    main(*sys.argv[1:])
