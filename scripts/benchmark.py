"""Measure training: python scripts/benchmark.py [part ...] [--pairs 5]

peers     steady-state steps per second of ours (16 lanes), Stable Baselines3 and SBX, interleaved, one thread each
steps     the cost of a step by sampler, and DQN's
breakdown what one step is made of
ceiling   what this machine can do: batched matmul at the update's shapes, and memory bandwidth
replay    the share of drawing and priorities in a step at a million items, and the replay's bytes over SB3's
cores     two conditions side by side on two cores, against one after the other
process   a whole `python -m train`, 16 seeds x 5,000 steps, against 16 whole runs of Stable Baselines3
scaling   the cost by lanes, neurons, buffer and h, and the memory
picture   draws results/benchmarks/speed.png from the tables
gpu       lane-steps per second on a GPU, by lanes and network (only when asked for by name)
Without a word: all but the last. Each measurement is a process of its own; the tables are results/benchmarks/*.csv.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from aser import provenance

ROOT = Path(__file__).resolve().parent.parent
PARTS = ("peers", "steps", "breakdown", "ceiling", "replay", "cores", "process", "scaling", "picture")
LANES, STEPS, WARM = 16, 1500, 400  # lanes of ours; measured steps; steps before the clock starts
MAZE = ["env=maze", "hyper=thesis", "eval.every=null"]
TRAIN = [sys.executable, "-m", "train", "env=maze", "hyper=thesis"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="part", help=", ".join(PARTS))
    parser.add_argument("--pairs", type=int, default=5, help="how often ours and a peer take turns")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "benchmarks")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        print(json.dumps(WORKERS[arguments.parts[0]](**json.loads(arguments.worker))))
        return
    if unknown := set(arguments.parts) - {*PARTS, "gpu"}:
        parser.error(f"{unknown.pop()}: there is no such part; allowed: {', '.join(PARTS)}, gpu")
    arguments.out.mkdir(parents=True, exist_ok=True)
    for part in arguments.parts or PARTS:
        if part == "picture":
            picture(arguments.out)
            continue
        source = {"date": time.strftime("%Y-%m-%d"), "commit": provenance.commit(), "code": provenance.code_digest()}
        rows = [{**row, **source} for row in globals()[f"measure_{part}"](arguments.pairs)]
        with (arguments.out / f"{part}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        print(f"\n{part}\n" + markdown(rows) + "\n", flush=True)


def measure_peers(pairs: int) -> list[dict]:
    """Ours and a peer in turn; the ratio of each pair, and its median."""
    work("ours", overrides=["sampler=uniform"])  # fills the compile cache
    rows = []
    for peer in ("sb3", "sbx"):
        ours, theirs = [], []
        for _ in range(pairs):
            ours.append(work("ours", overrides=["sampler=uniform"])["per_second"])
            theirs.append(work(peer)["per_second"])
        ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
        rows.append(
            {"peer": peer, "ours_lane_steps_per_second": f"{statistics.median(ours):.0f}",
             "peer_steps_per_second": f"{statistics.median(theirs):.0f}", "ratio": f"{statistics.median(ratios):.1f}",
             "lowest": f"{min(ratios):.1f}", "highest": f"{max(ratios):.1f}", "pairs": pairs}
        )  # fmt: skip
    return rows


def measure_process(pairs: int) -> list[dict]:
    """Whole processes, start and evaluations included, with a warm compile cache."""
    with tempfile.TemporaryDirectory() as folder:
        command = [*TRAIN, "sampler=uniform", "force=true", f"run_dir={folder}/run"]
        timed(command)
        ours = [timed(command) for _ in range(3)]
        first = [work("first_step", overrides=["sampler=uniform"])["seconds"] for _ in range(3)]
    theirs = sum(work("sb3_process", seed=seed)["seconds"] for seed in range(LANES))
    middle = statistics.median(ours)
    return [{"ours_seconds": f"{middle:.1f}", "sb3_seconds_16_runs": f"{theirs:.0f}", "ratio": f"{theirs / middle:.1f}",
             "seconds_to_first_update": f"{statistics.median(first):.1f}"}]  # fmt: skip


def measure_ceiling(pairs: int) -> list[dict]:
    """Matmul throughput at the shapes of one update and memory bandwidth, and the update's share of the first."""
    rows = []
    for hidden in ([24], [256, 256]):
        ceiling = work("ceiling", hidden=hidden)
        steps = 40 if hidden[0] == 256 else STEPS
        overrides = ["sampler=uniform", f"network.hidden={hidden}"]
        ours = work("ours", overrides=overrides, steps=steps, warm=5 if hidden[0] == 256 else WARM)
        flops = ours["per_second"] * update_flops(hidden)
        rows.append(
            {"hidden": "x".join(map(str, hidden)), "mflop_per_update": f"{update_flops(hidden) / 1e6:.1f}",
             "lane_steps_per_second": f"{ours['per_second']:.0f}", "gflops": f"{flops / 1e9:.1f}",
             "matmul_ceiling_gflops": f"{ceiling['gflops']:.1f}", "share": f"{flops / 1e9 / ceiling['gflops']:.2f}",
             "memory_gb_per_second": f"{ceiling['bandwidth']:.1f}"}
        )  # fmt: skip
    return rows


def measure_steps(pairs: int) -> list[dict]:
    """Each sampler's step over the uniform step, and DQN's in the corridor over SAC's there, taken in turn."""
    rows = []
    samplers = {name: [f"sampler={name}"] for name in ("per", "nstep", "aser", "oracle", "aser_shuffled", "aser_q")}
    for name, sampler in (("dqn", "uniform"), ("dqn_aser", "aser")):
        samplers[name] = [f"sampler={sampler}", "env=corridor", "agent=dqn", "hyper=tuned"]
    for overrides in [["sampler=uniform"], *samplers.values()]:
        work("ours", overrides=overrides, steps=50)
    for sampler, overrides in samplers.items():
        ratios, speeds = [], []
        where = ["env=corridor"] if sampler.startswith("dqn") else []
        for _ in range(pairs if sampler in ("per", "aser") else min(pairs, 2)):
            base = work("ours", overrides=["sampler=uniform", *where])["per_second"]
            speeds.append(work("ours", overrides=overrides)["per_second"])
            ratios.append(base / speeds[-1])
        rows.append({"sampler": sampler, "ratio": f"{statistics.median(ratios):.2f}", "lowest": f"{min(ratios):.2f}",
                     "highest": f"{max(ratios):.2f}", "pairs": len(ratios)})  # fmt: skip
    return rows


def measure_breakdown(pairs: int) -> list[dict]:
    """Microseconds of a step of 16 lanes and of its parts, each compiled and called alone: fused, they cost less."""
    rows = []
    for sampler in ("uniform", "per", "aser"):
        for part, micro in work("breakdown", overrides=[f"sampler={sampler}"]).items():
            rows.append({"sampler": sampler, "part": part, "microseconds": f"{micro:.0f}"})
    return rows


def measure_replay(pairs: int) -> list[dict]:
    """Drawing and priorities at growing buffers, and the bytes of an item over those in Stable Baselines3's buffer."""
    theirs = work("sb3_bytes")["bytes_per_item"]
    rows = []
    for size in (5_000, 100_000, 1_000_000):
        found = [work("replay", overrides=["sampler=per", f"buffer={size}"]) for _ in range(min(pairs, 3))]
        middle = sorted(found, key=lambda one: one["share"])[len(found) // 2]
        rows.append({"items": size, "step_microseconds": f"{middle['step']:.0f}", "draw": f"{middle['draw']:.0f}",
                     "write": f"{middle['write']:.0f}", "share": f"{middle['share']:.2f}",
                     "bytes_per_item": f"{middle['bytes_per_item']:.1f}", "sb3_bytes_per_item": f"{theirs:.1f}",
                     "bytes_ratio": f"{middle['bytes_per_item'] / theirs:.2f}"})  # fmt: skip
    return rows


def measure_cores(pairs: int) -> list[dict]:
    """Two whole runs of equal cost one after the other, and side by side with Hydra's joblib launcher."""
    one, both = [], []
    with tempfile.TemporaryDirectory() as folder:
        for k in range(min(pairs, 3) + 1):  # the first round fills the compile cache
            common = [*TRAIN, "sampler=per", "eval.every=1000", "steps=20000", "buffer=5000"]
            alone = [[*common, f"hyper.lr={lr}", f"run_dir={folder}/{k}-{lr}"] for lr in ("2e-2", "3e-2")]
            one.append(sum(timed(command) for command in alone))
            both.append(timed([*common, "-m", "hyper.lr=2e-2,3e-2", f"run_dir={folder}/{k}-both-${{hyper.lr}}"]))
    ratios = [a / b for a, b in zip(one[1:], both[1:], strict=True)]
    return [{"one_after_the_other_seconds": f"{statistics.median(one[1:]):.1f}",
             "side_by_side_seconds": f"{statistics.median(both[1:]):.1f}",
             "speedup": f"{statistics.median(ratios):.2f}", "lowest": f"{min(ratios):.2f}",
             "highest": f"{max(ratios):.2f}"}]  # fmt: skip


def measure_gpu(pairs: int) -> list[dict]:
    """Lane-steps per second on a GPU, and the shares of what its matmuls and its memory can do."""
    cases = [([24], lanes) for lanes in (16, 256, 1024, 4096)] + [([256, 256], lanes) for lanes in (16, 64)]
    rows = []
    for hidden, lanes in cases:
        most = work("ceiling", hidden=hidden, lanes=lanes, device="cuda")
        for sampler in ("uniform", "aser"):
            overrides = [f"sampler={sampler}", f"network.hidden={hidden}", f"seeds={lanes}", "device=cuda"]
            found = work("ours", overrides=overrides, steps=400, warm=100)
            flops, moved = update_flops(hidden) * found["per_second"], found["bytes_per_step"] * found["per_second"]
            rows.append({"hidden": "x".join(map(str, hidden)), "lanes": lanes, "sampler": sampler,
                         "lane_steps_per_second": f"{found['per_second']:.0f}",
                         "share_of_matmul_ceiling": f"{flops / most['gflops'] / 1e9:.2f}",
                         "share_of_bandwidth": f"{moved / most['bandwidth'] / 1e9:.2f}"})  # fmt: skip
    return rows


def measure_scaling(pairs: int) -> list[dict]:
    """How lane-steps per second and peak memory change with one size at a time."""
    cases: list[tuple[str, Any, list[str]]] = []
    cases += [("lanes", lanes, [f"seeds={lanes}"]) for lanes in (1, 4, 16, 64, 256)]
    cases += [("neurons", n, [f"network.hidden=[{n}]"]) for n in (24, 64, 256)]
    cases += [("neurons", "256x256", ["network.hidden=[256,256]"])]
    cases += [("buffer", size, [f"buffer={size}"]) for size in (5_000, 100_000, 1_000_000)]
    cases += [("h", h, [f"hyper.h={h}"]) for h in (1, 5, 10, 20)]
    rows = []
    for what, size, overrides in cases:
        for sampler in ("uniform", "per", "aser") if what != "h" else ("nstep", "aser"):
            large = size in ("256x256", 256) or size == 1_000_000
            found = work("ours", overrides=[f"sampler={sampler}", *overrides], steps=60 if large else 300,
                         warm=10 if large else 100, full=what == "buffer")  # fmt: skip
            rows.append({"what": what, "size": size, "sampler": sampler,
                         "lane_steps_per_second": f"{found['per_second']:.0f}",
                         "peak_mib": f"{found['peak_mib']:.0f}"})  # fmt: skip
    return rows


# Workers: each runs in a process of its own with one thread, and prints one line of JSON.


def build(overrides: Sequence[str], steps: int) -> Any:
    import torch

    torch.set_num_threads(1)
    import train
    from aser.allocator import keep_memory
    from aser.build import build as make

    keep_memory()

    sized = any(o.startswith("buffer=") for o in overrides)
    buffer = [] if sized else [f"buffer={max(steps, 5000)}"]
    return make(train.settings([*MAZE, f"steps={max(steps, 5000)}", *buffer, *overrides]), train.CONF)


def ours(overrides: Sequence[str], steps: int = STEPS, warm: int = WARM, full: bool = False) -> dict:
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
        seconds = elapsed(lambda: [training.advance() for _ in range(steps)])  # each ends with an action on the CPU
    lanes = len(training.setup.seeds)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    # What a lane's update cannot do without: its state read and written, and the drawn rows read.
    state = sum(leaf.numel() * leaf.element_size() for leaf in checkpoint.leaves(training.state)) / lanes
    moved = 2 * state + training.setup.buffer.sampler.batch * training.setup.buffer.storage.rows.shape[2] * 4
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

    from aser.lanes import batched, compiled
    from aser.learning import BLOCK
    from aser.noise import Stream

    training = build(overrides, 5000)
    setup, buffer, agent = training.setup, training.setup.buffer, training.setup.agent
    sampler = buffer.sampler
    with torch.no_grad():
        for _ in range(600):
            training.advance()
        state, hyper, clock, noise = training.state, setup.hyper, training._clock, training._numbers(training.step)
        obs, action, memory = torch.from_numpy(training._obs), training._actions[:, 0].numpy(), buffer.memory()
        index, weight = buffer.draw(noise[Stream.DRAW], hyper, clock)

        def assembled(state, memory, index, weight, hyper, clock, noise):
            return sampler.assemble(state, agent.temperature(state), memory, index, weight, hyper, clock, noise)

        draw = compiled(lambda noise, hyper, clock, masses: buffer.draw(noise[Stream.DRAW], hyper, clock, masses))
        gather = compiled(batched(assembled, (0, 0, 0, 0, 0, None, 0)))
        batch, n, _ = gather(state, memory, index, weight, hyper, clock, noise)
        update = compiled(batched(agent.update))
        act = compiled(batched(lambda state, obs, hyper, noise: agent.act(state, obs[:, None], hyper, noise)))
        mass = None if buffer.priorities is None else buffer.priorities.mass.gather(1, index)
        ends = {"terminated": action[:, 0] > 2, "truncated": action[:, 0] > 2}
        facts = {"obs": training._obs, "action": action, "reward": action[:, 0], "next_obs": training._obs} | ends
        parts = {
            "whole step": training.advance,
            "act": lambda: act(state, obs, hyper, noise),
            "environment": lambda: setup.envs.step(action),
            "store": lambda: buffer.append(facts),
            "random numbers (a block's share)": lambda: training._numbers._make(training._numbers._stepped),
            "draw": lambda: draw(noise, hyper, clock, buffer.masses()),
            "gather and unroll": lambda: gather(state, memory, index, weight, hyper, clock, noise),
            "update": lambda: update(state, batch, hyper, noise),
            "counts and priorities": lambda: buffer.write_back(index, n, mass, weight),
        }
        if sampler.prioritised and sampler.drawing.known == "now":
            judge = compiled(batched(lambda *args: sampler.priority(*args)))
            parts["criterion of the drawn items"] = lambda: judge(state, batch.obs, weight, memory, hyper)
        found = {name: min(micro(part) for _ in range(3)) for name, part in parts.items()}
    found["random numbers (a block's share)"] /= BLOCK
    return found


def replay(overrides: Sequence[str]) -> dict[str, float]:
    """Microseconds of a step at a full buffer, of its draw and of writing priorities back; bytes of one item."""
    import torch

    from aser.lanes import compiled
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
        drawn = [draw(u, hyper, training._clock, buffer.masses())[0] for u in numbers]  # everywhere in the buffer
        masses = [buffer.priorities.mass.gather(1, index) for index in drawn]
        draws = micro(lambda: [draw(u, hyper, training._clock, buffer.masses()) for u in numbers], 3) / len(numbers)
        pairs = list(zip(drawn, masses, strict=True))
        writes = micro(lambda: [buffer.priorities.write(*pair) for pair in pairs], 3) / len(pairs)
        ready = torch.ones(LANES, dtype=torch.float64)
        writes += micro(lambda: buffer.priorities.append(7, ready))
    kept = [buffer.storage.rows, buffer.storage.draw_count, buffer.storage.unroll_sum, buffer.priorities.leaves]
    for levels in (getattr(buffer.priorities, name, [None])[1:] for name in ("sums", "most", "least")):
        kept += levels
    size = sum(tensor.numel() * tensor.element_size() for tensor in kept) / LANES / buffer.storage.capacity
    return {"step": step, "draw": draws, "write": writes, "share": (draws + writes) / step, "bytes_per_item": size}


def sb3_bytes() -> dict:
    """Bytes of one item in Stable Baselines3's replay buffer."""
    buffer = peer("stable_baselines3", seed=0, total=5000).replay_buffer
    return {"bytes_per_item": sum(v.nbytes for v in vars(buffer).values() if hasattr(v, "nbytes")) / 5000}


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
        a, b = torch.randn(lanes, rows, inner, device=device), torch.randn(lanes, inner, columns, device=device)
        out = torch.empty(lanes, rows, columns, device=device)
        seconds += times * micro_of(lambda a=a, b=b, out=out: torch.bmm(a, b, out=out), 30) / 1e6
        flops += times * 2.0 * lanes * rows * inner * columns
    source = torch.randn(64 * 2**20, device=device)
    target = torch.empty_like(source)
    copied = micro_of(lambda: target.copy_(source), 3) / 1e6
    return {"gflops": flops / seconds / 1e9, "bandwidth": 2.0 * source.numel() * 4 / copied / 1e9}


def update_matmuls(hidden: Sequence[int], obs: int = 4, action: int = 2, batch: int = 256) -> list[tuple]:
    """(rows, inner, columns, how often) of the matmuls of one uniform SAC update of one lane."""
    actor, critic = [obs, *hidden, 2 * action], [obs + action, *hidden, 1]
    found = []
    for sizes, forward, backward, to_input in ((actor, 2, 1, 0), (critic, 6, 2, 2)):
        for depth, (inputs, outputs) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
            found.append((outputs, inputs, batch, forward))
            found.append((outputs, batch, inputs, backward))  # gradient of the weights
            found.append((inputs, outputs, batch, (backward if depth else 0) + to_input))  # and of the inputs
    return [(*shape, times) for *shape, times in found if times]


def update_flops(hidden: Sequence[int]) -> float:
    return sum(2.0 * a * b * c * times for a, b, c, times in update_matmuls(hidden))


def sb3(seconds: float = 6.0) -> dict:
    """Steps per second of Stable Baselines3's SAC once learning has started."""
    return peer_speed("stable_baselines3", seconds)


def sbx(seconds: float = 6.0) -> dict:
    """The same of SBX's, after JAX has compiled."""
    return peer_speed("sbx", seconds)


def peer_speed(package: str, seconds: float) -> dict:
    model = peer(package, seed=0, total=10**6)
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
    return sac("MlpPolicy", gymnasium.make("aser/Maze-v0"), policy_kwargs=policy, buffer_size=buffer, seed=seed)


def sb3_process(seed: int) -> dict:
    """Seconds of one whole run of 5,000 steps with an evaluation every 100, the interpreter's start included."""
    import gymnasium
    from stable_baselines3.common.callbacks import EvalCallback
    from stable_baselines3.common.monitor import Monitor

    model = peer("stable_baselines3", seed, 5000)
    judge = EvalCallback(Monitor(gymnasium.make("aser/Maze-v0")), n_eval_episodes=1, eval_freq=100, verbose=0)
    model.learn(5000, callback=judge)
    return {"seconds": time.time() - float(os.environ["BENCHMARK_STARTED"])}


WORKERS: dict[str, Callable[..., dict]] = {
    f.__name__: f for f in (ours, first_step, breakdown, replay, ceiling, sb3, sbx, sb3_bytes, sb3_process)
}


def picture(folder: Path) -> None:
    """speed.png: the peers, what a sampler costs, and how lane-steps per second grow with the lanes."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import pandas as pd

    from aser.study.styles import style

    peers, steps, scaling = (pd.read_csv(folder / f"{name}.csv") for name in ("peers", "steps", "scaling"))
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
    names = {"sb3": "Stable Baselines3", "sbx": "SBX (JAX)"}
    bars = [("ours, 16 lanes", peers["ours_lane_steps_per_second"].median())]
    bars += [(names[row.peer], row.peer_steps_per_second) for row in peers.itertuples()]
    axes[0].barh(*zip(*bars[::-1], strict=True), color=["0.6", "0.6", "C0"])
    for place, (_, value) in enumerate(bars[::-1]):
        axes[0].text(value, place, f" {value:,.0f}", va="center")
    axes[0].set(title="uniform SAC, one core", xlabel="(lane-)steps per second", xlim=(0, bars[0][1] * 1.3))
    cost = steps.sort_values("ratio")
    axes[1].barh(cost["sampler"], cost["ratio"], color=[style(name).colour for name in cost["sampler"]])
    axes[1].errorbar(cost["ratio"], cost["sampler"], fmt="none", ecolor="black", capsize=2,
                     xerr=[cost["ratio"] - cost["lowest"], cost["highest"] - cost["ratio"]])  # fmt: skip
    axes[1].axvline(1.0, color="black", linewidth=0.8)
    axes[1].set(title="cost of a sampler", xlabel="step over the uniform step")
    for sampler, rows in scaling[scaling["what"] == "lanes"].groupby("sampler"):
        axes[2].plot(rows["size"].astype(int), rows["lane_steps_per_second"], "o-", label=sampler,
                     color=style(sampler).colour)  # fmt: skip
    axes[2].set(title="more lanes", xscale="log", yscale="log", xlabel="lanes", ylabel="lane-steps per second",
                ylim=(None, 30000))  # fmt: skip
    axes[2].set_xticks([1, 4, 16, 64, 256], ["1", "4", "16", "64", "256"])
    axes[2].minorticks_off()
    axes[2].set_yticks([2000, 4000, 8000, 16000], ["2,000", "4,000", "8,000", "16,000"])
    axes[2].legend(frameon=False)
    figure.savefig(folder / "speed.png", dpi=150)


def work(worker: str, **arguments: Any) -> dict:
    """Run a worker in a process of its own."""
    command = [sys.executable, __file__, worker, "--worker", json.dumps(arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=single_thread(), cwd=ROOT)
    if done.returncode:
        raise SystemExit(f"benchmark: {worker} {arguments} failed:\n{done.stderr[-2000:]}")
    found = json.loads(done.stdout.strip().splitlines()[-1])
    print(f"{worker} {arguments} -> {found}", file=sys.stderr, flush=True)
    return found


def single_thread() -> dict[str, str]:
    one = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}
    one["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    return {**os.environ, **one, "BENCHMARK_STARTED": str(time.time())}


def timed(command: list[str]) -> float:
    start = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, env=single_thread(), cwd=ROOT)
    return time.perf_counter() - start


def elapsed(function: Callable) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def micro(function: Callable, times: int = 200) -> float:
    """Microseconds of one call."""
    function()
    return 1e6 * elapsed(lambda: [function() for _ in range(times)]) / times


def markdown(rows: list[dict]) -> str:
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(list(map(str, row.values())) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


if __name__ == "__main__":
    main()
