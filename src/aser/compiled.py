"""Pure functions of trees of tensors are traced once and compiled by inductor.

This file and `trees` are the only ones that use private parts of torch. They are tested with torch
2.6 to 2.13. `torch.compile` would give the same results, but it checks guards at every call. For
networks this small they cost a third of a step.

Compiling needs a compiler, a folder to write to and those private parts. Where it fails for any
reason, the function runs as it is.
"""

from __future__ import annotations

import ctypes
import functools
import getpass
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout

from aser.allocator import no_collection
from aser.errors import one_line
from aser.trees import collect, rebuild, tree_map

CACHE = "TORCHINDUCTOR_CACHE_DIR"
PATIENCE = 600  # seconds that a process waits for another one that compiles the same
_TRACING = ContextVar("tracing", default=False)


def tracing() -> bool:
    """Return whether the caller is being traced to be compiled."""
    return _TRACING.get()


def compiled(function: Callable, on: bool = True) -> Callable:
    """Return `function` as one graph for the shapes of its first call, or unchanged if not `on`."""
    return Compiled(function) if on else function


class Compiled:
    """A function of trees of tensors that is traced and compiled at its first call.

    Shapes and types never change during a run, so later calls check nothing. Trees consist of
    tuples, NamedTuples, lists and dictionaries. The function may write into its first argument and
    give it back, and is pure otherwise. On a GPU, each call overwrites the results of the call
    before. A function that cannot be compiled is called as it is, and a line says so.
    """

    def __init__(self, function: Callable):
        self.function = function
        self._graph: Callable | None = None
        self._eager = False  # compiling has failed

    def __call__(self, *args: Any) -> Any:
        leaves: list[torch.Tensor] = []
        collect(args, leaves)
        if self._graph is None:
            if self._eager:
                with torch.no_grad():
                    return self.function(*args)
            try:
                _once_more(lambda: self._trace(leaves, args))
            except Exception as error:
                self._graph, self._eager = None, True
                results = self(*args)  # a fault of the function itself is raised here
                _say_once(f"{type(error).__name__}: {error}")
                return results
        assert self._graph is not None
        return rebuild(self._outputs, iter(self._graph(*leaves)))

    @no_collection()
    def _trace(self, leaves: list[torch.Tensor], args: Any) -> None:
        # They are imported here since the import already writes to inductor's cache.
        import torch._inductor
        from torch._guards import TracingContext
        from torch._guards import tracing as tracing_in
        from torch._subclasses import FakeTensorMode
        from torch.fx.experimental.proxy_tensor import make_fx
        from torch.fx.experimental.symbolic_shapes import ShapeEnv

        _without_openssl()
        _remember_vector_instructions()

        def flat(*leaves: torch.Tensor) -> list[torch.Tensor]:
            results: list[torch.Tensor] = []
            self._outputs = self.function(*rebuild(args, iter(leaves)))
            collect(self._outputs, results)
            return results

        with torch.no_grad():
            # Inductor finds the result in its disk cache only if there is a shape environment.
            shapes = FakeTensorMode(shape_env=ShapeEnv())
            with tracing_in(TracingContext(shapes)):
                fixed: list[Any] = [shapes.from_tensor(leaf, static_shapes=True) for leaf in leaves]
                token = _TRACING.set(True)
                try:
                    traced = make_fx(flat)(*_trial(leaves, args))
                finally:
                    _TRACING.reset(token)
                of_leaves = [(str(leaf.dtype), str(leaf.device), *leaf.shape) for leaf in leaves]
                program = f"{torch.__version__} {of_leaves} {traced.code}"
                with _alone(program), _without_asserts():
                    self._graph = torch._inductor.compile(traced, fixed)
            self._outputs = tree_map(lambda _: None, self._outputs)
            if leaves[0].is_cuda:
                self._graph = Captured(self._graph, leaves, _trial(leaves, args))


def _trial(leaves: list[torch.Tensor], args: Any) -> list[torch.Tensor]:
    """The leaves of `args` for calls that may leave no trace: the first argument's are copies."""
    written: list[torch.Tensor] = []
    collect(args[0], written)
    return [leaf.clone() for leaf in written] + leaves[len(written) :]


class Captured:
    """A compiled graph whose kernel launches are recorded as one CUDA graph when it is made.

    The CUDA graph reads the tensors that it was recorded with. A call first copies its arguments to
    them, unless they are the same memory, as the replay's rows are.
    """

    def __init__(self, graph: Callable, leaves: list[torch.Tensor], trial: list[torch.Tensor]):
        self._inputs = leaves
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):  # first calls may allocate or tune, which cannot be recorded
                graph(*trial)
        torch.cuda.current_stream().wait_stream(stream)
        self._recorded = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._recorded):
            self._results = graph(*leaves)

    def __call__(self, *leaves: torch.Tensor) -> list[torch.Tensor]:
        pairs = zip(self._inputs, leaves, strict=True)
        moved = [(fixed, leaf) for fixed, leaf in pairs if fixed.data_ptr() != leaf.data_ptr()]
        if moved:
            torch._foreach_copy_([fixed for fixed, _ in moved], [leaf for _, leaf in moved])
        self._recorded.replay()
        return self._results


def _once_more(make: Callable[[], Any]) -> Any:
    """What `make` compiles; again where a killed process has left half a library in the cache."""
    with _ctrl_c(waits=True):
        try:
            return make()
        except Exception as error:
            broken = re.search(
                r"(/\S+\.so): (file too short|cannot read file|invalid ELF)", str(error)
            )
            if broken is None:
                raise
            Path(broken[1]).unlink(missing_ok=True)
            return make()


@contextmanager
def _alone(program: str) -> Iterator[None]:
    """Only one process at a time compiles `program`; those that wait find it in inductor's cache.

    The lock dies with the process that holds it. Once the program has been compiled, nobody waits.
    """
    done = _done(program)
    lock = FileLock(done.with_suffix(".lock"))
    with suppress(OSError, NotImplementedError):  # where no lock is to be had, each compiles
        done.parent.mkdir(parents=True, exist_ok=True)
        if not done.exists():
            _wait_for(lock)
        if done.exists():
            lock.release()  # those that have waited need not read the cache one after the other
    try:
        yield
        with suppress(OSError):
            done.touch()
    finally:
        lock.release()


def _done(program: str) -> Path:
    """The file in inductor's cache that says that `program` has been compiled."""
    name = hashlib.sha256(program.encode()).hexdigest()[:32]
    folder = Path(os.path.abspath(os.environ.get(CACHE) or _default_cache())) / "aser"
    return folder / f"{name}.done"


@functools.cache
def _without_openssl() -> None:
    """Let inductor compile where there is no program openssl, which it asks for digests of headers.

    It then works without precompiled headers, which takes longer.
    """
    if shutil.which("openssl") is None:
        import torch._inductor.config as inductor

        if hasattr(inductor, "cpp_cache_precompile_headers"):  # torch 2.6 does not have it
            inductor.cpp_cache_precompile_headers = False


@contextmanager
def _without_asserts() -> Iterator[None]:
    """Leave out inductor's checks of shapes and strides, in Python, that each call would repeat."""
    import torch._inductor.config as inductor

    names = ("size_asserts", "alignment_asserts")  # an older torch lacks the second
    with inductor.patch({name: False for name in names if hasattr(inductor, name)}):
        yield


@functools.cache
def _remember_vector_instructions() -> None:
    """Let torch ask only once which of the processor's vector instructions the compiler knows.

    It asks in every process, by short programs that it compiles for each set of instructions, the
    largest set first, and loads in processes of their own. That takes a second. What builds with
    one set builds with the smaller ones, and again with the same compiler.
    """
    with suppress(ImportError, AttributeError):
        from torch._inductor.cpu_vec_isa import VecISA

        ask, built = VecISA.check_build, set()

        def check_build(self: VecISA, code: str) -> bool:
            compiler, flags = _compiler(), self.build_arch_flags()
            version = _version(compiler)
            done = _done(f"{torch.__version__} {compiler} {version} {flags} {code}")
            if version is None:  # another compiler than the one that is known here
                return ask(self, code)
            if code in built or done.exists():
                built.add(code)
                return True
            if not ask(self, code):
                return False
            built.add(code)
            with suppress(OSError):
                done.parent.mkdir(parents=True, exist_ok=True)
                done.touch()
            return True

        VecISA.check_build = check_build  # type: ignore[method-assign]


def _wait_for(lock: FileLock) -> None:
    """Acquire the lock. A line says so where that takes long; after PATIENCE it goes on without."""
    try:
        lock.acquire(timeout=0)
    except Timeout:
        print("another process is compiling the same program: waiting for it", flush=True)
        with suppress(Timeout), _ctrl_c(waits=False):
            lock.acquire(timeout=PATIENCE)


@contextmanager
def _ctrl_c(waits: bool) -> Iterator[None]:
    """Whether Ctrl-C waits until the block is left, which may stand in another such block.

    A terminal would send it to the C++ compiler as well. Processes that a block starts in which it
    waits never see it.
    """
    if not hasattr(signal, "pthread_sigmask"):  # on Windows
        yield
        return
    how = signal.SIG_BLOCK if waits else signal.SIG_UNBLOCK
    before = signal.pthread_sigmask(how, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_said: list[str] = []  # why a function of this process was not compiled


def _say_once(reason: str) -> None:
    """Print why something runs eagerly: one line for each process, and not for each function."""
    if not _said:
        print(
            f"training could not be compiled ({one_line(reason)}): "
            "it runs eagerly, several times slower",
            flush=True,
        )
    _said.append(reason)


def why_not_compiled() -> str | None:
    """Name what compiling lacks on this machine; None where nothing is missing.

    Inductor calls the compiler that CXX names, or else the one compiler that it expects here.
    """
    if _version(_compiler()) is None:
        named = os.environ.get("CXX")
        return "no C++ compiler" if named is None else f"no C++ compiler at CXX={named}"
    if not (Path(sysconfig.get_paths()["include"]) / "Python.h").exists():
        return "no Python.h"
    return _CACHE_FAULT


def _compiler() -> str:
    return os.environ.get("CXX", "clang++" if sys.platform == "darwin" else "g++")


@functools.cache
def _version(compiler: str) -> str | None:
    """What the compiler tells of its version, which inductor asks for first; None if it fails."""
    try:
        command = [compiler, "--version"]
        told = subprocess.run(command, capture_output=True, text=True, errors="replace")
    except OSError:
        return None
    return told.stdout if told.returncode == 0 else None


def _cache_fault() -> str | None:
    """Say that inductor's cache has no folder to write to; None where it has one."""
    named = os.environ.get(CACHE)
    try:
        folder = _default_cache() if named is None else os.path.abspath(named)
        os.makedirs(folder, exist_ok=True)
        if os.access(folder, os.W_OK | os.X_OK):
            return None
    except OSError:
        pass
    where = "temporary folder" if named is None else f"folder at {CACHE}={named}"
    return f"no writable {where}"


def _default_cache() -> str:
    """Return the folder that inductor takes where the environment names none."""
    try:
        user = re.sub(r'[\\/:*?"<>|]', "_", getpass.getuser())
    except (KeyError, ModuleNotFoundError, OSError):
        user = f"uid_{os.getuid()}"
    return os.path.join(tempfile.gettempdir(), f"torchinductor_{user}")


def _import_without_cache() -> None:
    """Import what torch's gradients import, which fails where the cache has no folder at all."""
    named = os.environ.get(CACHE)
    os.environ[CACHE] = str(Path(__file__).parent)  # a folder that exists; nothing is written there
    try:
        import torch._dynamo  # noqa: F401
    finally:
        if named is None:
            del os.environ[CACHE]
        else:
            os.environ[CACHE] = named


_CACHE_FAULT = _cache_fault()
if _CACHE_FAULT is not None:
    _import_without_cache()


def shared_library(source: str) -> ctypes.CDLL:
    """Compile C++ code and load it; inductor's cache keeps the library for later processes."""
    from torch._inductor.codecache import CppCodeCache

    _without_openssl()
    _remember_vector_instructions()

    def load() -> ctypes.CDLL:
        with _alone(f"{torch.__version__} {source}"):
            return CppCodeCache.load(source)

    library: ctypes.CDLL = _once_more(load)
    return library
