"""Many commands, each in a process of its own, without the seconds that imports take.

A warm process imports everything once. For each command line it forks a child that calls
`train.main`, so a hang, a crash of the interpreter or a lack of memory ends that child only.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

TEST_FOLDER = Path(__file__).parent
MEMORY = 12 * 2**30  # bytes that a child may map beyond what it has; more is a MemoryError there


@dataclass(frozen=True)
class Running:
    """A command that was started."""

    pid: int
    out: Path
    err: Path
    began: float


@dataclass(frozen=True)
class Ended:
    """What came of a command. `status` is None where it had to be killed after its time."""

    status: int | None
    out: str
    err: str
    seconds: float


class Warm:
    """The warm process. Its children find the environments of this folder by their modules."""

    def __init__(self) -> None:
        one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        path = os.pathsep.join([str(TEST_FOLDER), *filter(None, sys.path)])
        self.process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **one_thread, "PYTHONPATH": path},
        )
        assert self._ask({}) == {"ready": True}

    def start(
        self,
        words: Sequence[str],
        folder: Path,
        environ: Mapping[str, str] | None = None,
        at: float = 0.0,
    ) -> Running:
        """Start `train` with these words in a folder, which gets a link to conf/.

        Processes with the same `at`, a time of the monotonic clock, begin at that same moment.
        """
        folder.mkdir(parents=True, exist_ok=True)
        place = folder.parent / f"{folder.name}-{time.monotonic_ns()}"
        out, err = place.with_suffix(".out"), place.with_suffix(".err")
        request = {"words": list(words), "folder": str(folder), "out": str(out), "err": str(err)}
        pid = self._ask(request | {"environ": dict(environ or {}), "at": at})["pid"]
        return Running(pid, out, err, time.monotonic())

    def wait(self, running: Running, seconds: float) -> Ended:
        """Wait for a command; it is killed when its seconds are over."""
        status = self._ask({"wait": running.pid, "seconds": seconds})["status"]
        took = time.monotonic() - running.began
        texts = [path.read_text(errors="replace") for path in (running.out, running.err)]
        running.out.unlink(), running.err.unlink()
        return Ended(status, *texts, took)

    def run(
        self,
        words: Sequence[str],
        folder: Path,
        seconds: float,
        environ: Mapping[str, str] | None = None,
    ) -> Ended:
        """Start a command and wait for it."""
        return self.wait(self.start(words, folder, environ), seconds)

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(10)

    def _ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())


def serve() -> None:
    """The warm process itself: one request a line, one answer a line."""
    import train

    conf, words = train.CONF, ["steps=3", "learning_starts=2", "eval.every=3", "compile=false"]
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(sys.stderr):
        words += [
            "sampler=uniform",
            "env.layout=toy",
            "seeds=1",
            "batch=2",
            f"run_dir={folder}/run",
        ]
        assert train.main(words) == 0
    for line in sys.stdin:
        request = json.loads(line)
        if "words" in request:
            answer = {"pid": os.fork()}
            if not answer["pid"]:
                child(request, conf)
        elif "wait" in request:
            answer = {"status": wait(request["wait"], request["seconds"])}
        else:
            answer = {"ready": True}
        print(json.dumps(answer), flush=True)


def wait(pid: int, seconds: float) -> int | None:
    """The exit status of a child, minus the signal that ended it, or None after `seconds`."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return None


def child(request: dict[str, Any], conf: Path) -> None:
    """One command, as `python -m train` would carry it out; it never returns."""
    import train

    status = 1
    try:
        for number, path in ((1, request["out"]), (2, request["err"])):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.environ |= request["environ"]
        os.chdir(request["folder"])
        here = Path(request["folder"], "conf")  # beside it, `results` will be this folder's own
        if not here.is_symlink():
            here.symlink_to(conf)
        train.CONF = here
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY, hard))
        time.sleep(max(0.0, request["at"] - time.monotonic()))
        status = train.main(request["words"])
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else int(error.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(status)


if __name__ == "__main__":
    serve()
