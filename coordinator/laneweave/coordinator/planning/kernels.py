"""Loading of the planners' compiled code (kernels), and its compilation.

Branch and bound and the rolling planner call functions that numba compiles, half a minute for each
of the two planners, and stores in its cache on disk; from there they load in less than a second.
TAPPA needs them only for its joint search, and can do without. So a real-time process never
compiles: it answers with TAPPA until another process, of low priority, has filled the cache
(`BackgroundCompilation`). A process whose results must not depend on the cache compiles before it
uses a kernel (`Kernels.load`).

A lock file lets one process at a time compile; the kernel of the operating system releases it when
its owner ends in any way. A killed compilation loses only the function that it was compiling.
numba compiles again for another processor or version of numba, and if a function's own file has
changed, but not if the file of a function that it calls has. So the cache contains a stamp file:
everything there was compiled from the files whose hash is in the name of the stamp file.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import structlog
from attrs import define, field

from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.runtime.processes import die_with_parent

log = structlog.get_logger(__name__)

NICENESS: Final = 10
"""Increase of the niceness of a compilation in the background."""
ATTEMPTS: Final = 2
"""Number of compilations; the second one if the first was killed."""
LOADING_S: Final = 2.0
"""Maximum time to wait until compiled code is loaded when the process ends."""
_PROGRAM: Final = f"from {__name__} import compile_for_parent; compile_for_parent()"


class NotCompiledError(Exception):
    """A kernel is not in the cache, and must not be compiled here."""


class CacheError(CommandFailedError):
    """There is no folder in which numba can store compiled code."""


@define(eq=False)
class Kernels:
    """The kernels of one planner; all methods may be called from several threads."""

    name: str
    """Name of the planner, for messages."""
    module: str
    """Module whose function `call_kernels` calls every kernel; see `planning`."""
    sources: tuple[str, ...]
    """Modules that contain the kernels; the stamp file is in the cache folder of the first."""
    _loaded: bool = field(default=False, init=False)
    _stamp: Path | None = field(default=None, init=False)
    """Stamp file, once it is known."""
    _tried_ns: int | None = field(default=None, init=False)
    """Time of the stamp file at the last attempt to load, see `_stamped_ns`; None: no attempt."""
    _lock: threading.RLock = field(factory=threading.RLock, init=False)

    @property
    def loaded(self) -> bool:
        """Whether the kernels can be called without a delay."""
        return self._loaded

    @property
    def known_missing(self) -> bool:
        """Whether this process has found them missing, and they have not been compiled since."""
        return not self._loaded and self._tried_ns == self._stamped_ns()

    def load_if_compiled(self) -> bool:
        """Load the kernels if all of them are compiled; return whether they are loaded.

        The first attempt imports numba (0.5 s); a repeated one reads the time of the stamp file.
        """
        with self._lock:
            if self._loaded or self.known_missing:
                return self._loaded
            try:
                self._find_stamp()
                self._tried_ns = self._stamped_ns()
                if self._tried_ns:
                    with _without_compiling():
                        self._call()
                    self._loaded = True
            except CacheError:
                self._tried_ns = self._stamped_ns()
            except NotCompiledError:
                pass
            return self._loaded

    def load(self) -> None:
        """Load the kernels; compile those that are not compiled, once no other process does.

        Raises:
            CacheError: there is no folder for the compiled code.
        """
        if self.load_if_compiled():
            return
        with self.compilation_lock():
            if not self.load_if_compiled():
                log.warning("compiling once, this takes half a minute", solver=self.name)
                self.compile()

    def available(self, *, compiled_only: bool) -> bool:
        """Load the kernels; return whether they are loaded.

        Args:
            compiled_only: whether not to compile those that are not compiled.

        Raises:
            CacheError: there is no folder for the compiled code.
        """
        if not compiled_only:
            self.load()
        return self.load_if_compiled()

    def compile(self) -> None:
        """Compile the kernels that are not compiled, and load all; needs `compilation_lock`.

        Raises:
            CacheError: there is no folder for the compiled code.
        """
        stamp = self._find_stamp()
        if not stamp.exists():
            self._delete_compiled()
            stamp.touch()
        self._call()
        self._loaded = True
        stamp.touch()  # the new time makes other processes try again

    @contextlib.contextmanager
    def compilation_lock(self) -> Iterator[None]:
        """Wait until no other process compiles these kernels, and exclude others.

        Raises:
            CacheError: there is no folder for the compiled code.
        """
        path = self._find_stamp().with_name(f"laneweave-{self.name}.lock")
        with path.open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _call(self) -> None:
        import_module(f"{__package__}.{self.module}").call_kernels()

    def _delete_compiled(self) -> None:
        """Delete what was compiled from other versions of the sources."""
        for name in self.sources:
            for path in _cache_folder(name).glob(f"{name.rpartition('.')[2]}.*.nb[ci]"):
                path.unlink(missing_ok=True)
        for path in self._find_stamp().parent.glob(f"laneweave-{self.name}-*.stamp"):
            path.unlink(missing_ok=True)

    def _find_stamp(self) -> Path:
        if self._stamp is None:
            folder = _cache_folder(self.sources[0])
            digest = hashlib.sha256()
            for name in self.sources:
                digest.update(Path(_module(name).__file__ or "").read_bytes())
            name = f"laneweave-{self.name}-{digest.hexdigest()[:16]}.stamp"
            self._stamp = folder / name
        return self._stamp

    def _stamped_ns(self) -> int:
        """Return the modification time of the stamp file; 0 if there is none."""
        with contextlib.suppress(FileNotFoundError):
            return 0 if self._stamp is None else self._stamp.stat().st_mtime_ns
        return 0


BRANCHING: Final = Kernels(
    "branching",
    "exact.branching",
    (
        "exact.branching_kernel",
        "exact.multipliers_kernel",
        "exact.negotiation_kernel",
        "exact.joint_kernel",
        "random_kernel",
    ),
)
ROLLING: Final = Kernels(
    "rolling",
    "rolling.path_search",
    ("rolling.search_kernel", "rolling.paths_kernel", "random_kernel"),
)
KERNELS: Final = {kernels.name: kernels for kernels in (BRANCHING, ROLLING)}


def _module(name: str) -> ModuleType:
    """Import a module that contains kernels.

    Raises:
        CacheError: numba finds no folder for the compiled code.
    """
    try:
        return import_module(f"{__package__}.{name}")
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
        allowed = "set NUMBA_CACHE_DIR to a folder that this user can write to"
        raise CacheError(f"no folder for compiled code: {allowed}") from error


def _cache_folder(name: str) -> Path:
    """Return the folder in which numba stores the code compiled from a module."""
    for found in vars(_module(name)).values():
        function = getattr(found, "py_func", None)
        if function is not None and function.__module__ == f"{__package__}.{name}":
            return Path(found.stats.cache_path)
    raise LookupError(f"{name} contains no kernel")


@contextlib.contextmanager
def _without_compiling() -> Iterator[None]:
    """Raise `NotCompiledError` instead of compiling a kernel in this thread."""
    from numba.core import event  # noqa: PLC0415 (numba is slow to load)

    thread = threading.get_ident()

    class Refusal(event.Listener):
        def on_start(self, event: Any) -> None:  # noqa: ANN401 (of numba)
            function = event.data["dispatcher"].py_func
            if threading.get_ident() == thread and function.__module__.startswith(__package__):
                raise NotCompiledError(function.__name__)

        def on_end(self, event: Any) -> None:  # noqa: ANN401
            pass

    with event.install_listener("numba:compile", Refusal()):
        yield


class BackgroundCompilation:
    """Compilation of one planner's kernels in another process, and loading in this one.

    The process has a low priority and ends with this one. If another process compiles the kernels
    already, this one waits for it.
    """

    def __init__(self, kernels: Kernels) -> None:
        """Start unless the kernels are loaded."""
        self._kernels = kernels
        self._process: subprocess.Popen[str] | None = None
        self._thread: threading.Thread | None = None
        self._closed = False
        self._lock = threading.Lock()
        if not kernels.loaded:
            log.warning(
                "a solver is being compiled; until then TAPPA makes all plans", solver=kernels.name
            )
            self._thread = threading.Thread(target=self._run, name="compilation", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Kill the process if it still runs; what it has compiled stays in the cache."""
        with self._lock:
            self._closed = True
            process = self._process
        if process is not None:
            process.kill()
            process.wait()
        if self._thread is not None:
            # One that loads compiled code when the interpreter ends could abort this process; one
            # that waits for another process cannot.
            self._thread.join(LOADING_S)

    def _run(self) -> None:
        solver, error = self._kernels.name, ""
        try:
            with self._kernels.compilation_lock():
                for _ in range(ATTEMPTS):
                    if self._closed or self._kernels.load_if_compiled():
                        break
                    error = self._compile()
            if self._closed:
                return
            if self._kernels.load_if_compiled():
                log.info("a solver is available", solver=solver)
                return
        except CacheError as problem:
            error = str(problem)
        if not self._closed:
            log.warning("a solver is not available", solver=solver, reason=error)

    def _compile(self) -> str:
        """Run a compilation to its end; return its last error."""
        with self._lock:
            if self._closed:
                return ""
            process = self._process = subprocess.Popen(  # noqa: S603
                [sys.executable, "-P", "-c", _PROGRAM, str(os.getpid()), self._kernels.name],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
        _, errors = process.communicate()
        return (errors.strip().splitlines() or [f"status {process.returncode}"])[-1]


def compile_for_parent() -> None:
    """Compile for the process that holds the lock; the program of `BackgroundCompilation`."""
    parent, name = sys.argv[1:]
    # Ctrl-C reaches the whole process group; the parent ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent(int(parent))
    os.nice(NICENESS)
    KERNELS[name].compile()
