"""Measure training: python benchmarks/measure.py [part ...] [--pairs 5]

peers     steady-state steps per second of ours (16 lanes), Stable Baselines3 and SBX, interleaved, one thread each;
          and of Stable Baselines3's DQN in the corridor
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
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from workers import LANES, STEPS, WARM, update_flops

from aser import provenance

ROOT = Path(__file__).resolve().parent.parent
PARTS = (
    "peers",
    "steps",
    "breakdown",
    "ceiling",
    "replay",
    "cores",
    "process",
    "scaling",
    "picture",
)
DQN = ["env=corridor", "agent=dqn", "hyper=tuned"]
TRAIN = [sys.executable, "-m", "train", "env=maze", "hyper=thesis"]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="part", help=", ".join(PARTS))
    parser.add_argument("--pairs", type=int, default=5, help="how often ours and a peer take turns")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "benchmarks")
    arguments = parser.parse_args()
    if unknown := set(arguments.parts) - {*PARTS, "gpu"}:
        parser.error(f"{unknown.pop()}: there is no such part; allowed: {', '.join(PARTS)}, gpu")
    arguments.out.mkdir(parents=True, exist_ok=True)
    for part in arguments.parts or PARTS:
        if part == "picture":
            picture(arguments.out)
            continue
        source = {
            "date": time.strftime("%Y-%m-%d"),
            "commit": provenance.commit(),
            "code": provenance.code_digest(),
        }
        rows = [{**row, **source} for row in globals()[f"measure_{part}"](arguments.pairs)]
        with (arguments.out / f"{part}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        print(f"\n{part}\n" + markdown(rows) + "\n", flush=True)


def measure_peers(pairs: int) -> list[dict]:
    """Ours and a peer in turn; the ratio of each pair, and its median."""
    rows = []
    for peer in ("sb3", "sbx", "sb3_dqn"):
        overrides = ["sampler=uniform", *(DQN if peer == "sb3_dqn" else [])]
        work("ours", overrides=overrides, steps=50)  # fills the compile cache
        ours, theirs = [], []
        for _ in range(pairs):
            ours.append(work("ours", overrides=overrides)["per_second"])
            theirs.append(work(peer)["per_second"])
        ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
        rows.append(
            {
                "peer": peer,
                "ours_lane_steps_per_second": f"{statistics.median(ours):.0f}",
                "peer_steps_per_second": f"{statistics.median(theirs):.0f}",
                "ratio": f"{statistics.median(ratios):.1f}",
                "lowest": f"{min(ratios):.1f}",
                "highest": f"{max(ratios):.1f}",
                "pairs": pairs,
            }
        )
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
    return [
        {
            "ours_seconds": f"{middle:.1f}",
            "sb3_seconds_16_runs": f"{theirs:.0f}",
            "ratio": f"{theirs / middle:.1f}",
            "seconds_to_first_update": f"{statistics.median(first):.1f}",
        }
    ]


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
            {
                "hidden": "x".join(map(str, hidden)),
                "mflop_per_update": f"{update_flops(hidden) / 1e6:.1f}",
                "lane_steps_per_second": f"{ours['per_second']:.0f}",
                "gflops": f"{flops / 1e9:.1f}",
                "matmul_ceiling_gflops": f"{ceiling['gflops']:.1f}",
                "share": f"{flops / 1e9 / ceiling['gflops']:.2f}",
                "memory_gb_per_second": f"{ceiling['bandwidth']:.1f}",
            }
        )
    return rows


def measure_steps(pairs: int) -> list[dict]:
    """Each sampler's step over the uniform step, and DQN's in the corridor over SAC's there, taken in turn."""
    rows = []
    samplers = {
        name: [f"sampler={name}"]
        for name in ("per", "nstep", "aser", "oracle", "aser_shuffled", "aser_q")
    }
    for name, sampler in (("dqn", "uniform"), ("dqn_aser", "aser")):
        samplers[name] = [f"sampler={sampler}", *DQN]
    for overrides in [["sampler=uniform"], *samplers.values()]:
        work("ours", overrides=overrides, steps=50)
    for sampler, overrides in samplers.items():
        ratios, speeds = [], []
        where = ["env=corridor"] if sampler.startswith("dqn") else []
        for _ in range(pairs if sampler in ("per", "aser") else min(pairs, 2)):
            base = work("ours", overrides=["sampler=uniform", *where])["per_second"]
            speeds.append(work("ours", overrides=overrides)["per_second"])
            ratios.append(base / speeds[-1])
        rows.append(
            {
                "sampler": sampler,
                "ratio": f"{statistics.median(ratios):.2f}",
                "lowest": f"{min(ratios):.2f}",
                "highest": f"{max(ratios):.2f}",
                "pairs": len(ratios),
            }
        )
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
        found = [
            work("replay", overrides=["sampler=per", f"buffer={size}"])
            for _ in range(min(pairs, 3))
        ]
        middle = sorted(found, key=lambda one: one["share"])[len(found) // 2]
        rows.append(
            {
                "items": size,
                "step_microseconds": f"{middle['step']:.0f}",
                "draw": f"{middle['draw']:.0f}",
                "write": f"{middle['write']:.0f}",
                "share": f"{middle['share']:.2f}",
                "bytes_per_item": f"{middle['bytes_per_item']:.1f}",
                "sb3_bytes_per_item": f"{theirs:.1f}",
                "bytes_ratio": f"{middle['bytes_per_item'] / theirs:.2f}",
            }
        )
    return rows


def measure_cores(pairs: int) -> list[dict]:
    """Two whole runs of equal cost one after the other, and side by side with Hydra's joblib launcher."""
    one, both = [], []
    with tempfile.TemporaryDirectory() as folder:
        for k in range(min(pairs, 3) + 1):  # the first round fills the compile cache
            common = [*TRAIN, "sampler=per", "eval.every=1000", "steps=20000", "buffer=5000"]
            alone = [
                [*common, f"hyper.lr={lr}", f"run_dir={folder}/{k}-{lr}"] for lr in ("2e-2", "3e-2")
            ]
            one.append(sum(timed(command) for command in alone))
            both.append(
                timed(
                    [
                        *common,
                        "-m",
                        "hyper.lr=2e-2,3e-2",
                        f"run_dir={folder}/{k}-both-${{hyper.lr}}",
                    ]
                )
            )
    ratios = [a / b for a, b in zip(one[1:], both[1:], strict=True)]
    return [
        {
            "one_after_the_other_seconds": f"{statistics.median(one[1:]):.1f}",
            "side_by_side_seconds": f"{statistics.median(both[1:]):.1f}",
            "speedup": f"{statistics.median(ratios):.2f}",
            "lowest": f"{min(ratios):.2f}",
            "highest": f"{max(ratios):.2f}",
        }
    ]


def measure_gpu(pairs: int) -> list[dict]:
    """Lane-steps per second on a GPU, and the shares of what its matmuls and its memory can do."""
    cases = [([24], lanes) for lanes in (16, 256, 1024, 4096)] + [
        ([256, 256], lanes) for lanes in (16, 64)
    ]
    rows = []
    for hidden, lanes in cases:
        most = work("ceiling", hidden=hidden, lanes=lanes, device="cuda")
        for sampler in ("uniform", "aser"):
            overrides = [
                f"sampler={sampler}",
                f"network.hidden={hidden}",
                f"seeds={lanes}",
                "device=cuda",
            ]
            found = work("ours", overrides=overrides, steps=400, warm=100)
            flops, moved = (
                update_flops(hidden) * found["per_second"],
                found["bytes_per_step"] * found["per_second"],
            )
            rows.append(
                {
                    "hidden": "x".join(map(str, hidden)),
                    "lanes": lanes,
                    "sampler": sampler,
                    "lane_steps_per_second": f"{found['per_second']:.0f}",
                    "share_of_matmul_ceiling": f"{flops / most['gflops'] / 1e9:.2f}",
                    "share_of_bandwidth": f"{moved / most['bandwidth'] / 1e9:.2f}",
                }
            )
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
            found = work(
                "ours",
                overrides=[f"sampler={sampler}", *overrides],
                steps=60 if large else 300,
                warm=10 if large else 100,
                full=what == "buffer",
            )
            rows.append(
                {
                    "what": what,
                    "size": size,
                    "sampler": sampler,
                    "lane_steps_per_second": f"{found['per_second']:.0f}",
                    "peak_mib": f"{found['peak_mib']:.0f}",
                }
            )
    return rows


def picture(folder: Path) -> None:
    """speed.png: the peers, what a sampler costs, and how lane-steps per second grow with the lanes."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import pandas as pd

    from aser.study.plots.style import style

    peers, steps, scaling = (
        pd.read_csv(folder / f"{name}.csv") for name in ("peers", "steps", "scaling")
    )
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
    names = {
        "sb3": "Stable Baselines3, SAC",
        "sbx": "SBX (JAX), SAC",
        "sb3_dqn": "Stable Baselines3, DQN",
    }
    dqn = peers["peer"] == "sb3_dqn"
    bars = []
    for text, rows in (("ours, SAC", peers[~dqn]), ("ours, DQN", peers[dqn])):
        bars.append((text, rows["ours_lane_steps_per_second"].median()))
        bars += [(names[row.peer], row.peer_steps_per_second) for row in rows.itertuples()]
    axes[0].barh(
        *zip(*bars[::-1], strict=True),
        color=["C0" if "ours" in text else "0.6" for text, _ in bars[::-1]],
    )
    for place, (_, value) in enumerate(bars[::-1]):
        axes[0].text(value, place, f" {value:,.0f}", va="center")
    most = max(value for _, value in bars)
    axes[0].set(
        title="uniform draws, one core",
        xlabel="(lane-)steps per second; ours with 16 lanes",
        xlim=(0, most * 1.3),
    )
    cost = steps.sort_values("ratio")
    axes[1].barh(
        cost["sampler"], cost["ratio"], color=[style(name).colour for name in cost["sampler"]]
    )
    axes[1].errorbar(
        cost["ratio"],
        cost["sampler"],
        fmt="none",
        ecolor="black",
        capsize=2,
        xerr=[cost["ratio"] - cost["lowest"], cost["highest"] - cost["ratio"]],
    )
    axes[1].axvline(1.0, color="black", linewidth=0.8)
    axes[1].set(title="cost of a sampler", xlabel="step over uniform SAC's (DQN: in the corridor)")
    for sampler, rows in scaling[scaling["what"] == "lanes"].groupby("sampler"):
        axes[2].plot(
            rows["size"].astype(int),
            rows["lane_steps_per_second"],
            "o-",
            label=sampler,
            color=style(sampler).colour,
        )
    axes[2].set(
        title="more lanes",
        xscale="log",
        yscale="log",
        xlabel="lanes",
        ylabel="lane-steps per second",
        ylim=(None, 30000),
    )
    axes[2].set_xticks([1, 4, 16, 64, 256], ["1", "4", "16", "64", "256"])
    axes[2].minorticks_off()
    axes[2].set_yticks([2000, 4000, 8000, 16000], ["2,000", "4,000", "8,000", "16,000"])
    axes[2].legend(frameon=False)
    figure.savefig(folder / "speed.png", dpi=150)


def work(worker: str, **arguments: Any) -> dict:
    """Run a worker of workers.py in a process of its own."""
    command = [
        sys.executable,
        str(Path(__file__).with_name("workers.py")),
        worker,
        json.dumps(arguments),
    ]
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


def markdown(rows: list[dict]) -> str:
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(list(map(str, row.values())) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


if __name__ == "__main__":
    main()
