"""Measure the speed of training.

    python benchmarks/measure.py [part ...] [--pairs 5]

Without a part, all are measured but gpu, which takes an hour. A part writes PART.csv to
results/benchmarks. Each worker runs in a process of its own, with one thread.
"""

from __future__ import annotations

import argparse
import csv
import inspect
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import peers
import picture
import workers

import train
from aser.compiled import CACHE
from aser.files import replacing

ROOT = Path(__file__).resolve().parent.parent
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
UNIFORM = ["sampler=uniform"]
CORRIDOR = ["env=corridor"]
DQN = [*CORRIDOR, "agent=dqn", "hyper=tuned"]
MUJOCO = ("Hopper-v5", "HalfCheetah-v5")
TRAIN = [sys.executable, "-m", "train", "env=maze", "hyper=thesis"]
# `python -m train`, which ends at once when it has made as many steps as its first argument says.
FIRST_UPDATE = """
import os, sys
import train
from aser.allocator import no_collection

with no_collection():
    from aser.training.loop import Training

advance = Training.advance

def and_end(self):
    advance(self)
    if self.step == int(sys.argv[1]):
        os._exit(0)

Training.advance = and_end
sys.exit(train.main(sys.argv[2:]) or "it ended before its first update")
"""

Row = dict[str, Any]


def main() -> None:
    functions = {**PARTS, "picture": picture.draw}
    parts = [f"  {name:10} {inspect.getdoc(function)}" for name, function in functions.items()]
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="\n".join(["parts:", *parts]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="*", metavar="part", help="what to measure")
    parser.add_argument("--pairs", type=int, default=5, help="how often two programs take turns")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "benchmarks")
    arguments = parser.parse_args()
    for name in arguments.parts:
        if name not in functions:
            parser.error(f"{name}: there is no such part; allowed: {', '.join(functions)}")
    os.environ |= ONE_THREAD
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.parts or [name for name in functions if name != "gpu"]:
        if name == "picture":
            picture.draw(arguments.out)
        else:
            write(name, PARTS[name](arguments.pairs), arguments.out)


def measure_peers(pairs: int) -> list[Row]:
    """Compare the speed of 16 lanes with Stable Baselines3 and SBX, in turn."""
    one = {"warm": workers.WARM}
    cases: list[tuple[str, list[str], Callable, Row]] = [
        ("sb3", UNIFORM, peers.sb3, one),
        ("sbx", UNIFORM, peers.sbx, one),
        ("sb3_dqn", [*UNIFORM, *DQN], peers.sb3_dqn, one),
    ]
    rows = []
    for name, overrides, peer, arguments in cases:
        ours, theirs = in_turn(pairs, overrides, {}, peer, arguments)
        rows.append(compared(name, ours, theirs))
    return rows


def measure_rejax(pairs: int) -> list[Row]:
    """Compare the speed of 16 lanes with rejax, in turn, and both with the matmul ceiling."""
    return [seeds_as_one_program(hidden, pairs) for hidden in ([24], [256, 256])]


def seeds_as_one_program(hidden: list[int], pairs: int) -> Row:
    """Compare with rejax in Pendulum, for networks of one size."""
    wide = len(hidden) > 1
    sizes = {"steps": 40, "warm": 5} if wide else {"steps": workers.STEPS, "warm": workers.WARM}
    theirs_too = {"hidden": hidden, "lanes": workers.LANES, "steps": 40 if wide else workers.STEPS}
    overrides = [*UNIFORM, "env=pendulum", f"network.hidden={hidden}"]
    ours, theirs = in_turn(pairs, overrides, sizes, peers.rejax, theirs_too)
    matmul = work(workers.ceiling, hidden=hidden)["gflops"]
    mflop = workers.update_flops(hidden, obs=3, action=1) / 1e6
    shares = {
        "ours_share_of_matmul": f"{median(ours) * mflop / 1e3 / matmul:.2f}",
        "peer_share_of_matmul": f"{median(theirs) * mflop / 1e3 / matmul:.2f}",
    }
    return {**compared("rejax" + "_256x256" * wide, ours, theirs), **shares}


def in_turn(
    pairs: int, overrides: list[str], sizes: Row, peer: Callable, arguments: Row
) -> tuple[list[float], list[float]]:
    """Steps per second of our program and of the peer's, measured in turn."""
    fill_cache(overrides)
    ours, theirs = [], []
    for _ in range(pairs):
        ours.append(work(workers.ours, overrides=overrides, **sizes)["per_second"])
        theirs.append(work(peer, **arguments)["per_second"])
    return ours, theirs


def compared(name: str, ours: list[float], theirs: list[float]) -> Row:
    return {
        "peer": name,
        "ours_lane_steps_per_second": f"{median(ours):.0f}",
        "peer_steps_per_second": f"{median(theirs):.0f}",
        **ratio_columns(ours, theirs, digits=1),
        "pairs": len(ours),
    }


def measure_steps(pairs: int) -> list[Row]:
    """Compare each sampler's step with uniform SAC's in the same environment."""
    samplers = [name for name in train.names(train.CONF, "sampler") if name != "uniform"]
    cases = {name: ([f"sampler={name}"], UNIFORM) for name in samplers}
    cases["dqn"] = ([*UNIFORM, *DQN], [*UNIFORM, *CORRIDOR])
    cases["dqn_aser"] = (["sampler=aser", *DQN], [*UNIFORM, *CORRIDOR])
    rows = []
    for name, (one, other) in cases.items():
        ratios = work(workers.in_turns, one=one, other=other, turns=pairs)["ratios"]
        columns = ratio_columns(ratios, [1.0] * pairs, digits=2)
        rows.append({"sampler": name, **columns, "pairs": pairs})
    return rows


def measure_breakdown(pairs: int) -> list[Row]:
    """Time the parts of a step alone; compiled as one they cost less."""
    return [
        {"sampler": sampler, "part": part, "microseconds": f"{microseconds:.0f}"}
        for sampler in ("uniform", "per", "aser")
        for part, microseconds in work(workers.breakdown, overrides=[f"sampler={sampler}"]).items()
    ]


def measure_update(pairs: int) -> list[Row]:
    """Time the parts of the update of uniform SAC, beside the floating-point work of each."""
    rows: list[Row] = []
    for part, microseconds in work(workers.update_parts, overrides=UNIFORM).items():
        row = {"part": part, "microseconds": f"{microseconds:.0f}", "mflop": "", "gflops": ""}
        if part in workers.PASSES:  # the others have no matrix multiplication
            mflop = workers.LANES * workers.update_flops([24], parts=[part]) / 1e6
            row |= {"mflop": f"{mflop:.1f}", "gflops": f"{1e3 * mflop / microseconds:.1f}"}
        rows.append(row)
    return rows


def measure_ceiling(pairs: int) -> list[Row]:
    """Compare the update with the machine's best rate of matmuls."""
    rows = []
    for hidden, steps, warm in (([24], workers.STEPS, workers.WARM), ([256, 256], 40, 5)):
        ceiling = work(workers.ceiling, hidden=hidden)
        overrides = [*UNIFORM, f"network.hidden={hidden}"]
        speed = work(workers.ours, overrides=overrides, steps=steps, warm=warm)["per_second"]
        flops = workers.update_flops(hidden)
        gflops = speed * flops / 1e9
        rows.append(
            {
                "hidden": "x".join(map(str, hidden)),
                "mflop_per_update": f"{flops / 1e6:.1f}",
                "lane_steps_per_second": f"{speed:.0f}",
                "gflops": f"{gflops:.1f}",
                "matmul_ceiling_gflops": f"{ceiling['gflops']:.1f}",
                "share": f"{gflops / ceiling['gflops']:.2f}",
                "memory_gb_per_second": f"{ceiling['bandwidth']:.1f}",
            }
        )
    return rows


def measure_environments(pairs: int) -> list[Row]:
    """Measure the share of MuJoCo's environments in a step."""
    rows = []
    for id in MUJOCO:
        for hidden, steps in (([64], 300), ([256, 256], 20)):
            overrides = ["env=mujoco", f"env.id={id}", "hyper=sb3", *UNIFORM]
            overrides.append(f"network.hidden={hidden}")
            runs = [
                work(workers.environments, overrides=overrides, steps=steps)
                for _ in range(min(pairs, 3))
            ]
            run = sorted(runs, key=lambda run: run["environments"] / run["step"])[len(runs) // 2]
            share = run["environments"] / run["step"]
            rows.append(
                {
                    "task": id,
                    "hidden": "x".join(map(str, hidden)),
                    "step_microseconds": f"{run['step']:.0f}",
                    "environments": f"{run['environments']:.0f}",
                    "share": f"{share:.2f}",
                    # Of a second core that is idle, and of processes that cost nothing.
                    "most_gain": f"{1 / (1 - share / 2):.2f}",
                }
            )
    return rows


def measure_stepping(pairs: int) -> list[Row]:
    """Compare environments that are stepped in sequence with halves in two processes."""
    rows = []
    for id in MUJOCO:
        plain, spread = [], []
        for _ in range(pairs):
            plain.append(work(workers.stepping, id=id, halves=False))
            spread.append(work(workers.stepping, id=id, halves=True))
        seconds = [[run["seconds"] for run in runs] for runs in (plain, spread)]
        processor = [[run["processor"] for run in runs] for runs in (spread, plain)]
        rows.append(
            {
                "task": id,
                **ratio_columns(*seconds, digits=2, name="speedup"),
                "processor_time": ratio_columns(*processor, digits=2)["ratio"],
                "pairs": pairs,
                "load": f"{os.getloadavg()[0]:.1f}",  # 0 on an idle machine
            }
        )
    return rows


def measure_replay(pairs: int) -> list[Row]:
    """Time PER's draws and priorities at growing buffers, and count an item's bytes."""
    theirs = work(peers.sb3_bytes)["bytes_per_item"]
    rows = []
    for size in (5_000, 100_000, 1_000_000):
        overrides = ["sampler=per", f"buffer={size}"]
        results = [work(workers.replay, overrides=overrides) for _ in range(min(pairs, 3))]
        result = sorted(results, key=lambda result: result["share"])[len(results) // 2]
        rows.append(
            {
                "items": size,
                "step_microseconds": f"{result['step']:.0f}",
                "draw": f"{result['draw']:.0f}",
                "write": f"{result['write']:.0f}",
                "share": f"{result['share']:.2f}",
                "bytes_per_item": f"{result['bytes_per_item']:.1f}",
                "sb3_bytes_per_item": f"{theirs:.1f}",
                "bytes_ratio": f"{result['bytes_per_item'] / theirs:.2f}",
            }
        )
    return rows


def measure_cores(pairs: int) -> list[Row]:
    """Time two runs side by side on two cores, and one after the other."""
    command = [*TRAIN, "sampler=per", "eval.every=1000", "steps=20000", "buffer=5000"]
    in_turn, side_by_side = [], []
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(min(pairs, 3) + 1):
            seconds = 0.0
            for lr in ("2e-2", "3e-2"):
                seconds += timed([*command, f"hyper.lr={lr}", f"run_dir={folder}/{turn}-{lr}"])
            in_turn.append(seconds)
            run_dir = f"run_dir={folder}/{turn}-both-${{hyper.lr}}"
            side_by_side.append(timed([*command, "-m", "hyper.lr=2e-2,3e-2", run_dir]))
    in_turn, side_by_side = in_turn[1:], side_by_side[1:]  # the first turn fills the compile cache
    return [
        {
            "one_after_the_other_seconds": f"{median(in_turn):.1f}",
            "side_by_side_seconds": f"{median(side_by_side):.1f}",
            **ratio_columns(in_turn, side_by_side, digits=2, name="speedup"),
        }
    ]


def measure_process(pairs: int) -> list[Row]:
    """Time `python -m train` with 16 seeds, and 16 runs of Stable Baselines3."""
    with tempfile.TemporaryDirectory() as folder:
        command = [*TRAIN, *UNIFORM, "force=true", f"run_dir={folder}/run"]
        timed(command)  # fills the compile cache
        ours = median(timed(command) for _ in range(3))
    theirs = sum(started(peers.sb3_process, seed=seed) for seed in range(workers.LANES))
    return [
        {
            "ours_seconds": f"{ours:.1f}",
            "sb3_seconds_16_runs": f"{theirs:.0f}",
            "ratio": f"{theirs / ours:.1f}",
        }
    ]


def measure_startup(pairs: int) -> list[Row]:
    """Time a run of 16 seeds to its first update, with an empty compile cache and a full one."""
    command = [sys.executable, "-c", FIRST_UPDATE, str(workers.FIRST_UPDATE), *TRAIN[3:]]
    command += ["eval.every=null", "force=true"]
    rows = []
    for sampler in ("uniform", "aser"):
        empty, full = [], []
        for _ in range(pairs):
            with tempfile.TemporaryDirectory() as folder:
                run = [*command, f"sampler={sampler}", f"run_dir={folder}/run"]
                for seconds in (empty, full):
                    seconds.append(timed(run, {CACHE: f"{folder}/cache"}))
        for cache, seconds in (("empty", empty), ("full", full)):
            spread = {"seconds": median(seconds), "lowest": min(seconds), "highest": max(seconds)}
            numbers = {column: f"{value:.1f}" for column, value in spread.items()}
            rows.append({"sampler": sampler, "cache": cache, **numbers})
    return rows


# The threshold is its last quantile from the first update on, so unrolls have their full length
# wherever they are timed.
SETTLED_AT_ONCE = {"aser": ["hyper.k_s=1"]}


def measure_scaling(pairs: int) -> list[Row]:
    """Measure speed and memory by lanes, neurons, buffer and h."""
    cases: list[tuple[str, Any, str]] = []
    cases += [("lanes", lanes, f"seeds={lanes}") for lanes in (1, 4, 16, 64, 256)]
    cases += [("neurons", width, f"network.hidden=[{width}]") for width in (24, 64, 256)]
    cases += [("neurons", "256x256", "network.hidden=[256,256]")]
    cases += [("buffer", size, f"buffer={size}") for size in (5_000, 100_000, 1_000_000)]
    cases += [("h", h, f"hyper.h={h}") for h in (1, 5, 10, 20)]
    rows = []
    for what, size, override in cases:
        steps, warm = (60, 10) if size in ("256x256", 256, 1_000_000) else (300, 100)
        for sampler in ("nstep", "aser") if what == "h" else ("uniform", "per", "aser"):
            result = work(
                workers.ours,
                overrides=[f"sampler={sampler}", override, *SETTLED_AT_ONCE.get(sampler, [])],
                steps=steps,
                warm=warm,
                full=what == "buffer",
            )
            rows.append(
                {
                    "what": what,
                    "size": size,
                    "sampler": sampler,
                    "lane_steps_per_second": f"{result['per_second']:.0f}",
                    "peak_mib": f"{result['peak_mib']:.0f}",
                }
            )
    return rows


def measure_gpu(pairs: int) -> list[Row]:
    """Measure the speed on a GPU, by lanes and network."""
    cases = [([24], lanes) for lanes in (16, 256, 1024, 4096)]
    cases += [([256, 256], lanes) for lanes in (16, 64)]
    rows = []
    for hidden, lanes in cases:
        ceiling = work(workers.ceiling, hidden=hidden, lanes=lanes, device="cuda")
        common = [f"network.hidden={hidden}", f"seeds={lanes}", "device=cuda"]
        for sampler in ("uniform", "aser"):
            overrides = [f"sampler={sampler}", *common, *SETTLED_AT_ONCE.get(sampler, [])]
            result = work(workers.ours, overrides=overrides, steps=400, warm=100)
            speed = result["per_second"]
            flops, moved = speed * workers.update_flops(hidden), speed * result["bytes_per_step"]
            rows.append(
                {
                    "hidden": "x".join(map(str, hidden)),
                    "lanes": lanes,
                    "sampler": sampler,
                    "lane_steps_per_second": f"{speed:.0f}",
                    "share_of_matmul_ceiling": f"{flops / 1e9 / ceiling['gflops']:.2f}",
                    "share_of_bandwidth": f"{moved / 1e9 / ceiling['bandwidth']:.2f}",
                }
            )
    return rows


PARTS: dict[str, Callable[[int], list[Row]]] = {
    "peers": measure_peers,
    "rejax": measure_rejax,
    "steps": measure_steps,
    "breakdown": measure_breakdown,
    "update": measure_update,
    "ceiling": measure_ceiling,
    "environments": measure_environments,
    "stepping": measure_stepping,
    "replay": measure_replay,
    "cores": measure_cores,
    "process": measure_process,
    "startup": measure_startup,
    "scaling": measure_scaling,
    "gpu": measure_gpu,
}


def source(worker: Callable) -> str:
    """The file of a worker. Its decorator may lie in another one."""
    return str(inspect.getsourcefile(inspect.unwrap(worker)))


def work(worker: Callable, **arguments: Any) -> dict[str, Any]:
    """The result of a worker, a function of workers.py or peers.py, from a process of its own."""
    command = [sys.executable, source(worker), worker.__name__, json.dumps(arguments)]
    process = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    if process.returncode:
        raise SystemExit(f"benchmark: {worker.__name__} {arguments}\n{process.stderr[-2000:]}")
    result = json.loads(process.stdout.splitlines()[-1])
    print(f"{worker.__name__} {arguments} -> {result}", file=sys.stderr, flush=True)
    return result


def started(worker: Callable, **arguments: Any) -> float:
    """Seconds that a worker measures from the start of its process on."""
    return work(worker, started=time.time(), **arguments)["seconds"]


def timed(command: list[str], environment: Mapping[str, str] | None = None) -> float:
    """Seconds that a command takes."""
    env = {**os.environ, **(environment or {})}
    return workers.elapsed(
        lambda: subprocess.run(command, check=True, capture_output=True, cwd=ROOT, env=env)
    )


def fill_cache(overrides: Sequence[str]) -> None:
    """Compile what a training needs, so that no later process spends time on it."""
    work(workers.ours, overrides=overrides, steps=50)


def ratio_columns(
    above: Sequence[float], below: Sequence[float], digits: int, name: str = "ratio"
) -> Row:
    """The median, lowest and highest of the ratios of pairs."""
    ratios = [a / b for a, b in zip(above, below, strict=True)]
    values = {name: median(ratios), "lowest": min(ratios), "highest": max(ratios)}
    return {column: f"{value:.{digits}f}" for column, value in values.items()}


def write(part: str, rows: list[Row], folder: Path) -> None:
    """Write a part's table with the date and the code that was measured, and print it."""
    source = {"date": time.strftime("%Y-%m-%d"), **work(workers.code)}
    with replacing(folder / f"{part}.csv") as draft, draft.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[0], *source], lineterminator="\n")
        writer.writeheader()
        writer.writerows({**row, **source} for row in rows)
    print(f"\n{part}")
    for row in rows:
        print(*(f"{column}={value}" for column, value in row.items()), sep="  ", flush=True)


if __name__ == "__main__":
    main()
