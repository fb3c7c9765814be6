"""Where compiling fails, for any reason, everything runs as it is, and one line says so."""

import gc
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest
import torch

from aser import compiled as compiling
from aser.allocator import no_collection
from aser.compiled import why_not_compiled

needs_compiler = pytest.mark.skipif(why_not_compiled() is not None, reason="nothing to break here")

# What a training does: a gradient under vmap, with our operators where they can be had.
PROGRAM = """
import torch
from aser.compiled import compiled, why_not_compiled
from aser import native

def f(w, x):
    return torch.func.grad(lambda w: (w @ x).sin().square().sum())(w)

lacking = why_not_compiled()
served = native.serves(torch.zeros(1))
w, x = torch.randn(3, 4, 5), torch.randn(3, 5, 70)
mine = compiled(torch.func.vmap(f), lacking is None)
other = compiled(torch.func.vmap(lambda w, x: 2.0 * f(w, x)), lacking is None)
expected = torch.func.vmap(f)(w, x)
for _ in range(2):
    assert torch.allclose(mine(w, x), expected, rtol=1e-4, atol=1e-4)
    assert torch.allclose(other(w, x), 2.0 * expected, rtol=1e-4, atol=1e-4)
print(lacking, served)
"""

# A compiler that tells its version, but fails or writes what cannot be loaded.
BROKEN = """#!/bin/sh
for word in "$@"; do case "$word" in
    --version|-dumpversion|-dumpfullversion) exec g++ "$@";;
esac; done
echo "out of luck" >&2
while [ $# -gt 0 ]; do [ "$1" = -o ] && echo garbage > "$2"; shift; done
exit STATUS
"""


def said(tmp_path, **environment):
    """What the program says, by line, with other variables of the environment."""
    cache = {compiling.CACHE: str(tmp_path / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, **cache, **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.splitlines()


@needs_compiler
@pytest.mark.parametrize("status", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_compiler_that_breaks_leaves_what_is_slower(status, tmp_path):
    script = tmp_path / "broken"
    script.write_text(BROKEN.replace("STATUS", str(status)))
    script.chmod(0o755)
    operators, training, last = said(tmp_path, CXX=str(script))
    assert operators.startswith("operators.cpp was not compiled (")
    assert training.startswith("training could not be compiled (")
    assert training.endswith("): it runs eagerly, several times slower") and len(training) < 250
    assert last == "None False"


@needs_compiler
@pytest.mark.slow
def test_no_openssl_is_needed(tmp_path):
    programs = tmp_path / "programs"
    programs.mkdir()
    for name in ("g++", "gcc", "as", "ld"):
        (programs / name).symlink_to(shutil.which(name))
    assert said(tmp_path, PATH=str(programs)) == ["None True"]


def test_headers_are_compiled_before_only_where_there_is_openssl(monkeypatch):
    inductor = pytest.importorskip("torch._inductor.config")
    if not hasattr(inductor, "cpp_cache_precompile_headers"):
        pytest.skip("this torch compiles no headers before")
    for found, expected in (("/usr/bin/openssl", True), (None, False)):
        monkeypatch.setattr(shutil, "which", lambda name, found=found: found)
        with inductor.patch(cpp_cache_precompile_headers=True):
            compiling._without_openssl.__wrapped__()
            assert inductor.cpp_cache_precompile_headers == expected


@needs_compiler
@pytest.mark.slow
def test_a_library_that_a_killed_process_left_half_written_is_made_again(tmp_path):
    assert said(tmp_path) == ["None True"]
    libraries = list((tmp_path / "cache").rglob("*.main.so"))
    assert libraries
    for library, size in zip(libraries, [0, 100, *[0] * len(libraries)], strict=False):
        os.truncate(library, size)
    assert said(tmp_path) == ["None True"]


# A compiler that is sent what a terminal sends to all processes at Ctrl-C.
INTERRUPTED = """#!/bin/sh
case "$*" in *" -o "*) kill -INT $$;; esac
exec g++ "$@"
"""


@needs_compiler
@pytest.mark.slow
def test_ctrl_c_does_not_reach_the_compiler_of_a_training(tmp_path):
    script = tmp_path / "interrupted"
    script.write_text(INTERRUPTED)
    script.chmod(0o755)
    assert said(tmp_path, CXX=str(script)) == ["None True"]


@pytest.mark.parametrize("compiler", ["/bin/false", "/nowhere/g++", ""])
def test_a_compiler_that_is_none_is_named(compiler, tmp_path):
    assert said(tmp_path, CXX=compiler) == [f"no C++ compiler at CXX={compiler} False"]


@needs_compiler
def test_a_cache_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    wrong = str(tmp_path / "file" / "cache")
    assert said(tmp_path, **{compiling.CACHE: wrong}) == [
        f"no writable folder at TORCHINDUCTOR_CACHE_DIR={wrong} False"
    ]


@needs_compiler
def test_a_cache_that_fails_later_is_said(tmp_path):
    """A cache with files in place of the folders that inductor makes, as a full disk would be."""
    cache = tmp_path / "cache"
    cache.mkdir()
    for number in range(256):
        (cache / f"{number:02x}").touch()
    for number in range(36**2):
        first, second = divmod(number, 36)
        digits = "0123456789abcdefghijklmnopqrstuvwxyz"
        (cache / (digits[first] + digits[second])).touch()
    lines = said(tmp_path)
    assert [line.partition(" (")[0] for line in lines] == [
        "operators.cpp was not compiled",
        "training could not be compiled",
        "None False",
    ]


def test_what_compiling_lacks_is_named(tmp_path, monkeypatch):
    compiler = tmp_path / "compiler"
    compiler.write_text("#!/bin/sh\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    monkeypatch.setattr("sysconfig.get_paths", lambda: {"include": str(tmp_path)})
    monkeypatch.setattr(compiling, "_CACHE_FAULT", None)
    assert why_not_compiled() == "no Python.h"
    (tmp_path / "Python.h").touch()
    assert why_not_compiled() is None
    monkeypatch.setattr(compiling, "_CACHE_FAULT", "no writable temporary folder")
    assert why_not_compiled() == "no writable temporary folder"
    monkeypatch.setenv("CXX", str(tmp_path / "none"))
    assert why_not_compiled() == f"no C++ compiler at CXX={tmp_path / 'none'}"
    monkeypatch.delenv("CXX")
    monkeypatch.setenv("PATH", str(tmp_path))
    compiling._version.cache_clear()
    assert why_not_compiled() == "no C++ compiler"
    compiling._version.cache_clear()


def test_torch_asks_for_vector_instructions_once(tmp_path, monkeypatch):
    """Sets of instructions are asked for from the largest on, by one code and more of its own."""
    isa = pytest.importorskip("torch._inductor.cpu_vec_isa")
    asked = []

    class Set:
        def __init__(self, flags):
            self.flags = flags

        def build_arch_flags(self):
            return self.flags

    def ask(self, code):
        asked.append((self.flags, code))
        return self.flags != "-mtoo-new"

    def process(*questions):
        """What a process that asks these questions hears, and what torch had to find out."""
        asked.clear()
        monkeypatch.setattr(isa.VecISA, "check_build", ask)
        compiling._remember_vector_instructions.__wrapped__()
        heard = [isa.VecISA.check_build(Set(flags), code) for flags, code in questions]
        return heard, list(asked)

    monkeypatch.setenv(compiling.CACHE, str(tmp_path))
    monkeypatch.setattr(compiling, "_version", lambda compiler: "first")
    new, large, small = ("-mtoo-new", "all"), ("-mlarge", "all"), ("-msmall", "all")
    more = ("-mlarge", "more")
    assert process(new, large, more, small) == ([False, True, True, True], [new, large, more])
    assert process(new, large, more, small) == ([False, True, True, True], [new])
    assert process(small) == ([True], [small])  # it was never built, and no larger set is there
    monkeypatch.setattr(compiling, "_version", lambda compiler: "second")
    assert process(large, small) == ([True, True], [large])


ASKING = """
from torch._inductor.cpu_vec_isa import VecISA
ask = VecISA.check_build
def counted(self, code):
    print("asked")
    return ask(self, code)
VecISA.check_build = counted
"""


@needs_compiler
@pytest.mark.slow
def test_a_second_process_does_not_ask_again(tmp_path):
    environment = {**os.environ, compiling.CACHE: str(tmp_path)}
    asked = []
    for _ in range(2):
        command = [sys.executable, "-c", ASKING + PROGRAM]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        asked.append(done.stdout.count("asked"))
    assert asked[0] > 0 and asked[1] == 0


def test_what_a_compiler_tells_need_not_be_text(tmp_path):
    compiler = tmp_path / "compiler"
    compiler.write_text("#!/bin/sh\nprintf 'version \\351'\n")
    compiler.chmod(0o755)
    assert compiling._version(str(compiler)) == "version \ufffd"


@pytest.mark.parametrize("on", [True, False])
def test_collection_is_as_it_was_before(on):
    @no_collection()
    def failing():
        assert not gc.isenabled()
        raise ValueError

    (gc.enable if on else gc.disable)()
    try:
        for _ in range(2):
            with pytest.raises(ValueError):
                failing()
            assert gc.isenabled() == on
    finally:
        gc.enable()


@pytest.fixture
def silent(monkeypatch):
    """No function of this process has said yet that it is not compiled."""
    monkeypatch.setattr(compiling, "_said", [])


def failing(error):
    def trace(self, leaves, args):
        raise error

    return trace


def test_one_line_is_said_for_many_functions(silent, monkeypatch, capsys):
    monkeypatch.setattr(compiling.Compiled, "_trace", failing(OSError(28, "No space left")))
    for factor in (2.0, 3.0):
        function = compiling.compiled(lambda x, factor=factor: {"y": factor * x})
        for _ in range(2):
            assert function(torch.ones(3))["y"].tolist() == [factor] * 3
    assert capsys.readouterr().out == (
        "training could not be compiled (OSError: [Errno 28] No space left): "
        "it runs eagerly, several times slower\n"
    )


def test_a_branch_on_a_value_runs_eagerly(silent, capsys):
    function = compiling.compiled(lambda x: 2.0 * x if float(x.sum()) > 0 else x)
    assert function(torch.ones(2)).tolist() == [2, 2] and function(-torch.ones(2)).tolist() == [
        -1,
        -1,
    ]


def test_a_fault_of_the_function_itself_is_raised(silent, capsys):
    function = compiling.compiled(lambda x: x @ torch.ones(7))
    with pytest.raises(RuntimeError, match="size"):
        function(torch.ones(2))
    assert capsys.readouterr().out == ""


def test_an_interrupt_is_not_a_failure_to_compile(silent, monkeypatch):
    monkeypatch.setattr(compiling.Compiled, "_trace", failing(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        compiling.compiled(lambda x: x)(torch.ones(2))


# One function is compiled; how often inductor had to, and what the function gives.
COUNTED = """
import torch
from torch._dynamo.utils import counters
from aser.compiled import compiled

x = torch.arange(70.0)
assert torch.allclose(compiled(lambda x: x.sin() + 1.0)(x), x.sin() + 1.0, atol=1e-5)
print("compiled", counters["inductor"]["fxgraph_cache_miss"])
"""
WAITING = "another process is compiling the same program: waiting for it"


def begun(tmp_path, **environment):
    """A process that compiles one function, in a group of its own."""
    return subprocess.Popen(
        [sys.executable, "-c", COUNTED],
        env={**os.environ, compiling.CACHE: str(tmp_path / "cache"), **environment},
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@needs_compiler
def test_processes_that_start_at_once_compile_once(tmp_path):
    processes = [begun(tmp_path) for _ in range(4)]
    last = [process.communicate()[0].splitlines()[-1] for process in processes]
    assert sorted(last) == ["compiled 0"] * 3 + ["compiled 1"]


@needs_compiler
@pytest.mark.slow
def test_who_waits_for_a_process_that_is_killed_compiles(tmp_path):
    script, reached = tmp_path / "asleep", tmp_path / "reached"
    sleeps = f'case "$*" in *" -o "*) touch {reached}; sleep 600;; esac'
    script.write_text(f'#!/bin/sh\n{sleeps}\nexec g++ "$@"\n')
    script.chmod(0o755)
    first = begun(tmp_path, CXX=str(script))
    try:
        while not reached.exists():
            assert first.poll() is None
            time.sleep(0.1)
        second = begun(tmp_path)
        assert second.stdout.readline().strip() == WAITING
        os.killpg(first.pid, signal.SIGKILL)
        assert second.communicate()[0].splitlines() == ["compiled 1"]
        assert second.returncode == 0
    finally:
        with suppress(ProcessLookupError):
            os.killpg(first.pid, signal.SIGKILL)
        first.communicate()


@needs_compiler
def test_tensors_that_a_function_holds_are_constants():
    held = torch.tensor([1.0, 2.0, 3.0])
    function = compiling.compiled(lambda x: x * held + torch.tensor([5.0]))
    assert function(torch.ones(3)).tolist() == [6.0, 7.0, 8.0]
    assert function._graph is not None  # it does not run as it is


@needs_compiler
def test_a_function_that_writes_into_an_argument_does_so_once_for_each_call():
    def add(total, x):
        total[:2] += x
        return total, total.sum()

    function, total = compiling.compiled(add), torch.zeros(3)
    for call in (1.0, 2.0, 3.0):
        same, summed = function(total, torch.ones(2))
        assert total.tolist() == [call, call, 0.0] and summed == 2 * call
        assert same.data_ptr() == total.data_ptr()
    assert function._graph is not None  # it does not run as it is
