"""Tune hyper-parameters: python scripts/sweep.py env=maze sampler=aser [key=value ...]

The trials of Optuna train several seeds each, at once, as lanes of one program. The best five are
trained again with fresh seeds, and the best of these becomes
conf/hyper/tuned/TASK/SAMPLER.yaml. The other files are in results/sweeps/STUDY/. The same command
goes on with an interrupted sweep, and a finished one with more trials. Several commands may share
one storage.

  python scripts/sweep.py env=corridor sampler=per trials=50 workers=2
  python scripts/sweep.py env=corridor sampler=uniform agent=dqn
  python scripts/sweep.py env=maze sampler=aser storage=postgresql+psycopg://user@host/tuning
  python scripts/sweep.py -m env=maze sampler=uniform,per,aser
      runs one sweep for each sampler, side by side.
  python scripts/sweep.py -m hydra/launcher=submitit_slurm worker=0,1,2,3 env=maze sampler=aser
      starts four workers on a cluster.
  python scripts/sweep.py all
      runs every sweep of conf/sweep/_all.yaml, as many at a time as there are cores.
  python scripts/sweep.py report
      compares tuned and thesis' values of finished sweeps on the reported seeds.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from joblib import Parallel, delayed

import train
from aser.errors import ConfigError
from aser.script import ended
from aser.settings import compose
from aser.sweep import jobs, settings, study

RESULTS = Path(__file__).resolve().parent.parent / "results"
FLAGS = {"-h", "--help", "-m", "--multirun"}


def main(arguments: Sequence[str]) -> int:
    """Tune as the arguments say. Returns the exit status, which is 1 after a wrong input."""
    try:
        flags, words = compose.command_line(arguments, FLAGS)
        overrides = settings.translated(words)
        if flags & {"-h", "--help"}:
            print(f"{__doc__}\n{(train.CONF / 'sweep' / 'tpe.yaml').read_text()}")
        elif words[:1] == ["all"]:
            return tune_all(words[1:])
        elif words == ["report"]:
            study.report(train.CONF, RESULTS)
        elif flags & {"-m", "--multirun"}:
            failed = jobs.launch(overrides, train.CONF, RESULTS)
            for line in failed:
                print(f"sweep: failed: {line}", file=sys.stderr)
            return 1 if failed else 0
        else:
            composed = compose.compose(overrides, train.CONF)
            jobs.check([composed], train.CONF)
            study.tune(composed, train.CONF, RESULTS)
    except ConfigError as error:
        print(f"sweep: {error}", file=sys.stderr)
        return 1
    except (KeyboardInterrupt, SystemExit) as stop:
        print("sweep: interrupted; the same command goes on", file=sys.stderr)
        code = getattr(stop, "code", 130)
        return code if isinstance(code, int) else 1
    return 0


def tune_all(words: Sequence[str]) -> int:
    """Run the sweeps of conf/sweep/_all.yaml. Returns 1 if any has failed or was killed, else 0."""
    pairs = [(f"env={env}", f"sampler={name}") for env, name in settings.listed(train.CONF)]
    commands = [[sys.executable, __file__, *pair, *words] for pair in pairs]
    running: list[subprocess.Popen] = []
    stopped = threading.Event()

    def call(command: Sequence[str]) -> int:
        if stopped.is_set():
            return 1
        running.append(process := subprocess.Popen(command))
        return process.wait()

    try:
        codes = Parallel(n_jobs=-1, backend="threading")(delayed(call)(one) for one in commands)
    except BaseException:
        stopped.set()
        for process in running:
            process.terminate()  # a sweep gives its trials back, and ends
        for process in running:
            process.wait()
        raise
    study.compare(train.CONF, RESULTS)
    return int(any(codes))


if __name__ == "__main__":
    sys.path.insert(0, "")  # an environment of one's own lies where the command is given
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # trials are given back, as by Ctrl-C
    sys.exit(ended(lambda: main(sys.argv[1:])))
