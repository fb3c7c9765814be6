"""How commands end: unread, as in `compare.py A B | head -3`, stopped, and killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def piped(*command):
    """The status and the errors of a command whose reader has left before it prints."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    return process.wait(), process.stderr.read()


def test_every_script_ends_by_its_status():
    scripts = sorted((ROOT / "scripts").glob("*.py"))
    assert len(scripts) > 5
    for path in [*scripts, ROOT / "src/train.py"]:
        assert "sys.exit(ended(" in path.read_text(), path


@pytest.mark.parametrize("script", ["same.py", "compare.py"])
def test_a_script_ends_without_a_word(script):
    status, errors = piped(sys.executable, str(ROOT / "scripts" / script), "--help")
    assert status in (0, 1) and errors == ""  # argparse may ignore that nobody reads its help


def test_ctrl_c_is_one_line():
    stopped = "import sys; from aser.script import ended; sys.exit(ended(lambda: 1 / 0))"
    stopped = stopped.replace("lambda: 1 / 0", "lambda: (_ for _ in ()).throw(KeyboardInterrupt)")
    done = subprocess.run([sys.executable, "-c", stopped], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


WORKERS = """
import os, sys, time
from pathlib import Path
from joblib import Parallel, delayed
from aser.script import end_with

def job(number, parent, folder):
    end_with(parent)
    Path(folder, str(os.getpid())).touch()
    time.sleep(100)

if __name__ == "__main__":
    here = os.getpid(), sys.argv[1]
    Parallel(n_jobs=2, batch_size=1)(delayed(job)(number, *here) for number in range(6))
"""


def alive(process):
    """Whether it runs: a process that has ended may stay in the table until somebody asks."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=["TERM", "KILL"])
def test_workers_end_with_a_command_that_is_killed(tmp_path, number):
    """Else they would train on, and the same command would find their folders taken."""
    (tmp_path / "many.py").write_text(WORKERS)
    (tmp_path / "seen").mkdir()
    command = [sys.executable, str(tmp_path / "many.py"), str(tmp_path / "seen")]
    process, until = subprocess.Popen(command), time.monotonic() + 60
    while len(os.listdir(tmp_path / "seen")) < 2:
        assert time.monotonic() < until
        time.sleep(0.1)
    process.send_signal(number)
    process.wait()
    workers, until = os.listdir(tmp_path / "seen"), time.monotonic() + 20
    while any(map(alive, workers)):
        assert time.monotonic() < until
        time.sleep(0.1)
    assert os.listdir(tmp_path / "seen") == workers  # none of the waiting jobs has begun


def test_a_full_disk_below_the_screen_is_one_line():
    code = "import sys; from aser.script import ended; sys.exit(ended(lambda: print('x') or 0))"
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert "No space left on device" in done.stderr


def test_a_train_py_of_ones_own_is_no_obstacle(tmp_path):
    (tmp_path / "train.py").write_text("raise SystemExit(9)")
    (tmp_path / "my_criteria.py").write_text(
        "def zero(state, obs, gaussian):\n    return obs[0] * 0\n"
    )
    words = ["--cfg", "sampler=aser", "criterion.name=my_criteria.zero"]
    command = [sys.executable, str(ROOT / "src/train.py"), *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and "name: my_criteria.zero" in done.stdout, done.stderr


def test_a_run_ends_without_a_word_of_its_folder(tmp_path):
    words = ["debug=smoke", "hyper=thesis", "env.layout=toy", f"run_dir={tmp_path / 'run'}"]
    status, errors = piped(sys.executable, "-m", "train", *words)
    assert (status, errors) == (1, "")
