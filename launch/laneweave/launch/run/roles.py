"""Start of a role in a new process, and the role's main function there.

Forking a process from a server that has imported and prepared what roles need (`preload`) is much
cheaper than starting an interpreter.
"""

from __future__ import annotations

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
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from types import ModuleType
from typing import Any

import structlog

from laneweave.launch.faults.namespace_processes import join_namespace
from laneweave.launch.run.logs import log_to_file, log_to_terminal
from laneweave.launch.run.run_folder import LOG_FILE
from laneweave.launch.run_methods import FORMATION
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.runtime.message_faults import CoreWrapper, unwrapped
from laneweave.protocol.runtime.processes import die_with_parent
from laneweave.protocol.security.access_control import access_of

log = structlog.get_logger(__name__)

PRELOADED = "laneweave.launch.run.preload"
LAUNCHER = "LANEWEAVE_LAUNCHER"
"""Environment variable of the fork server with the process ID of its launcher."""
THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that limit the threads of linear algebra libraries."""
AGENT_NICENESS = 5
RECONNECT_S = 0.1
"""Time between attempts to connect in runs with faults."""
ORPHAN_S = 5.0
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
    for name in THREAD_LIMITS:
        os.environ.setdefault(name, "1")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([PRELOADED])
    # Starting the resource tracker unblocks SIGINT, so it must not start below.
    resource_tracker.ensure_running()
    # Ctrl-C reaches the whole process group. Role processes inherit the blocked SIGINT, because
    # the launcher terminates them in the right order. A Ctrl-C in the meantime is delivered later.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ[LAUNCHER] = str(os.getpid())
    try:
        forkserver.ensure_running()
    finally:
        del os.environ[LAUNCHER]
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
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


def run_role(role: str, name: str, tables: dict[str, Any], options: dict[str, Any]) -> None:
    """Run a role in this process to completion; the target of `start_role`."""
    die_with_parent()
    if "namespace" in options:
        # Namespaces are properties of threads: join before other threads start.
        join_namespace(options["namespace"])
    die_with_supervisor()
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)
    tempfile.tempdir = options["temporary"]
    log_to_file(Path(options["folder"]) / LOG_FILE, role, name)
    try:
        while not _run_once(role, name, tables, options):
            time.sleep(RECONNECT_S)
    except BadInputError as error:
        log.error("cannot start", reason=str(error))  # noqa: TRY400 (the message is complete)
        sys.exit(2)
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


def die_with_supervisor() -> None:
    """Terminate this process when the launcher exits for any reason.

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
        os.kill(os.getpid(), signal.SIGTERM)
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

    network = parse_scenario(tables).network
    run_router((network.endpoint, *options.get("listen", ())), network.lease_s)


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
