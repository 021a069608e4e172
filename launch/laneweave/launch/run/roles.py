"""Start of a role in a new process, and the role's main function there.

Forking a process from a server that has imported and prepared what roles need (`preload`) is much
cheaper than starting an interpreter.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cache
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from types import ModuleType
from typing import Any

import structlog

from laneweave.launch.faults.namespace_processes import join_namespace
from laneweave.launch.run.logs import log_to_file, log_to_terminal
from laneweave.launch.run.run_folder import LOG_FILE, ROUTER_READY_FILE
from laneweave.launch.run_methods import FORMATION
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.runtime.message_faults import CoreWrapper, unwrapped
from laneweave.protocol.runtime.processes import (
    ROLE_STOP,
    STOP_SIGNALS,
    die_with_parent,
    raise_interrupts,
)
from laneweave.protocol.runtime.temporary_folders import hold_folder, temporary_folder
from laneweave.protocol.security.access_control import access_of, guard_of

log = structlog.get_logger(__name__)

PRELOADED = "laneweave.launch.run.preload"
LAUNCHER = "LANEWEAVE_LAUNCHER"
"""Environment variable of the fork server with the process ID of its launcher."""
THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that limit the threads of linear algebra libraries."""
BAD_INPUT = 2
"""Exit status of a role that cannot start."""
AGENT_NICENESS = 5
RECONNECT_S = 0.1
"""Time between attempts to connect in runs with faults."""
ORPHAN_S = 20.0
"""Grace period of a process after its launcher has died."""
GC_THRESHOLD = 50_000
"""New objects between garbage collections; the default of 700 slows down a run by 6 %."""
_PR_SET_NAME = 15


def tune_garbage_collector() -> None:
    """Exclude existing objects from garbage collection, and raise the threshold.

    Roles create almost no reference cycles, and the collector frees nothing else.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(GC_THRESHOLD)


@contextlib.contextmanager
def tuned_garbage_collector() -> Iterator[None]:
    """Tune the garbage collector as above for a run in a process that does other things, too."""
    thresholds = gc.get_threshold()
    tune_garbage_collector()
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()


def fork_server(solvers: Collection[str] = ()) -> ForkServerContext:
    """Return a context that forks processes from a server, once the server is prepared.

    Linear algebra is limited to one thread per process, because many processes share few cores.

    Args:
        solvers: solvers, as in `KERNELS`, that must be compiled before this returns. Compiling one
            takes half a minute; Ctrl-C ends the wait and the server.

    Raises:
        CommandFailedError: the server has exited, or a solver cannot be compiled.
    """
    _make_socket_folder()
    for name in THREAD_LIMITS:
        os.environ.setdefault(name, "1")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([PRELOADED])
    # Stop signals may be sent to all processes at once, but the launcher ends its roles in the
    # right order. The fork server inherits the blocked signals until it can ignore them
    # (`preload`), the resource tracker only SIGHUP: it ignores the others, and its start unblocks
    # them here, too. A signal in the meantime is delivered later.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
    os.environ[LAUNCHER] = str(os.getpid())
    try:
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, (*STOP_SIGNALS, ROLE_STOP))
        forkserver.ensure_running()
    finally:
        del os.environ[LAUNCHER]
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    # Starting it waits for the server; at this point Ctrl-C still raises KeyboardInterrupt.
    problems, sender = context.Pipe(duplex=False)
    with problems, sender:
        first = context.Process(target=_compile, args=(tuple(solvers), sender), name="processes")
        _start(first)
        first.join()
        if first.exitcode:
            reason = problems.recv() if problems.poll() else f"status {first.exitcode}"
            raise CommandFailedError(f"{', '.join(solvers)}: cannot be compiled: {reason}")
    return context


def _compile(solvers: Sequence[str], problems: Connection) -> None:
    """Compile solvers unless the fork server has loaded them; runs in a process of its own."""
    from laneweave.coordinator.planning.kernels import KERNELS, CacheError

    die_with_parent()
    die_with_supervisor()
    log_to_terminal()
    try:
        for solver in solvers:
            KERNELS[solver].load()
    except CacheError as error:
        problems.send(str(error))
        sys.exit(1)


@cache
def _make_socket_folder() -> None:
    """Let multiprocessing use a temporary folder that does not outlive this process.

    Its own remains if the process is killed.
    """
    closing = contextlib.ExitStack()
    atexit.register(closing.close)
    folder = closing.enter_context(temporary_folder())
    multiprocessing.current_process()._config.setdefault("tempdir", str(folder))  # type: ignore[attr-defined]  # noqa: SLF001


def start_role(
    context: ForkServerContext,
    role: str,
    name: str,
    tables: dict[str, Any],
    options: dict[str, Any],
) -> ForkServerProcess:
    """Start a role in a new process.

    Args:
        context: result of `fork_server`.
        role: `router`, `coordinator`, `bridge` or `agent`.
        name: name for logs and process lists.
        tables: the scenario, as returned by `to_tables`.
        options: `folder` of the run; `temporary`, folder for temporary files; the role's own
            options; optionally `namespace`, id of a process whose network namespace the role joins,
            and `faults`, the `MessageFaults` of the role.

    Raises:
        CommandFailedError: the fork server has exited, or the process cannot be created.
    """
    process = context.Process(target=run_role, args=(role, name, tables, options), name=name)
    _start(process)
    return process


def _start(process: ForkServerProcess) -> None:
    try:
        with _main_module_hidden():
            process.start()
    except (EOFError, OSError) as error:
        reason = str(error) or "the fork server has ended"
        raise CommandFailedError(f"cannot start {process.name}: {reason}") from error


@contextlib.contextmanager
def _main_module_hidden() -> Iterator[None]:
    """Keep a new process from importing the main module of this one, such as a user's script.

    Roles need nothing from it, and a script that calls `laneweave.run` would start more runs.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def end_role(process: ForkServerProcess) -> None:
    """Ask a role to end in good order."""
    if process.is_alive() and process.pid is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process.pid, ROLE_STOP)


def run_role(role: str, name: str, tables: dict[str, Any], options: dict[str, Any]) -> None:
    """Run a role in this process to completion; the target of `start_role`."""
    with contextlib.suppress(KeyboardInterrupt):
        become_role(name, options)
        log_to_file(Path(options["folder"]) / LOG_FILE, role, name)
        _run_until_connected(role, name, tables, options)


def become_role(name: str, options: dict[str, Any]) -> None:
    """Make this forked process a role, which its launcher ends: `ROLE_STOP` interrupts it."""
    raise_interrupts(ROLE_STOP)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {ROLE_STOP})
    die_with_parent(number=ROLE_STOP)
    if "namespace" in options:
        # Namespaces are properties of threads: join before other threads start.
        join_namespace(options["namespace"])
    die_with_supervisor(ROLE_STOP)
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)
    tempfile.tempdir = options["temporary"]
    hold_folder(Path(tempfile.tempdir))


def _run_until_connected(
    role: str, name: str, tables: dict[str, Any], options: dict[str, Any]
) -> None:
    try:
        while not _run_once(role, name, tables, options):
            time.sleep(RECONNECT_S)
    except BadInputError as error:
        log.error("cannot start", reason=str(error))  # noqa: TRY400 (the message is complete)
        sys.exit(BAD_INPUT)
    except Exception:
        log.exception("role failed")
        sys.exit(1)


def _run_once(role: str, name: str, tables: dict[str, Any], options: dict[str, Any]) -> bool:
    """Run a role; return False (retry) if a fault prevented it from connecting."""
    try:
        _ROLES[role](name, tables, options)
    except BadInputError as error:
        # A fault may have killed the router or cut the link; the bridge starts before all faults.
        if "faults" not in options or role == "bridge" or error.field != "network.endpoint":
            raise
        return False
    return True


def die_with_supervisor(number: signal.Signals = signal.SIGTERM) -> None:
    """Send a signal to this process when the launcher exits for any reason; kill it if it hangs.

    The parent process is the fork server, which runs until its last child process has exited.
    """
    supervisor = multiprocessing.parent_process()
    if supervisor is None:
        return

    parent = os.getppid()

    def watch() -> None:
        supervisor.join()
        if os.getppid() == parent:
            resume_children(parent)
        os.kill(os.getpid(), number)
        time.sleep(ORPHAN_S)
        os._exit(1)

    threading.Thread(target=watch, name="supervisor", daemon=True).start()


def resume_children(parent: int) -> None:
    """Resume processes paused by faults, so that they notice that the launcher has died."""
    with contextlib.suppress(OSError):
        children = Path(f"/proc/{parent}/task/{parent}/children").read_text(encoding="ascii")
        for child in children.split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(child), signal.SIGCONT)


def _wrap(options: dict[str, Any]) -> CoreWrapper:
    faults = options.get("faults")
    return unwrapped if faults is None else faults.wrap


def _router(_: str, tables: dict[str, Any], options: dict[str, Any]) -> None:
    from laneweave.protocol.transports.zenoh.transport import run_router

    scenario = parse_scenario(tables)
    network = scenario.network
    run_router(
        (*network.listens_at, *options.get("listen", ())),
        network.lease_s,
        field="network.listen" if network.listen else "network.endpoint",
        ready=(Path(options["temporary"]) / ROUTER_READY_FILE).touch,
        guard=guard_of(scenario),
    )


def _coordinator(name: str, tables: dict[str, Any], options: dict[str, Any]) -> None:
    from laneweave.coordinator.process import run_coordinator

    run_coordinator(parse_scenario(tables), name, _wrap(options))


def _bridge(_: str, tables: dict[str, Any], options: dict[str, Any]) -> None:
    from laneweave.sim_bridge.process import run_bridge

    run_bridge(
        parse_scenario(tables),
        Path(options["folder"]),
        FORMATION,
        options["pace"],
        _wrap(options),
        breakdowns=options.get("breakdowns", ()),
    )


def _agent(_: str, tables: dict[str, Any], options: dict[str, Any]) -> None:
    from laneweave.agents.process import run_agents

    # Bridge, router and coordinators take priority, because all roles wait for them.
    os.nice(AGENT_NICENESS)
    scenario, vehicles = parse_scenario(tables), options["vehicles"]
    run_agents(
        scenario, access_of(scenario, f"vehicle.{vehicles[0]}"), vehicles, wrap=_wrap(options)
    )


_ROLES: dict[str, Callable[[str, dict[str, Any], dict[str, Any]], None]] = {
    "router": _router,
    "coordinator": _coordinator,
    "bridge": _bridge,
    "agent": _agent,
}
