"""Commands whose output nobody reads to its end, as in `compare.py A B | head -3`."""

import subprocess
import sys
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
