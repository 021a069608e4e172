"""Starting a role in a process of its own.

Processes come from a fork server that has imported and prepared what agents need and opened nothing
(`preloaded`), so that one more vehicle costs a fork and not the start of an interpreter.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from typing import Any

import structlog
from attrs import frozen

from laneweave.launch.faults.control_files import BoardWord
from laneweave.launch.faults.network_namespaces import join_namespace
from laneweave.launch.run.logs import log_to_file
from laneweave.protocol.config.loading import parse_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.runtime.message_faults import FaultyCore, MessageRule, Wrap, bare
from laneweave.protocol.runtime.node import Core
from laneweave.protocol.runtime.processes import die_with_parent
from laneweave.protocol.security.rights import access_of

log = structlog.get_logger(__name__)

PRELOADED = "laneweave.launch.run.fork_server"
THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that bound the threads of linear algebra."""
AGENT_NICENESS = 5
CONNECT_AGAIN_S = 0.1
"""Where there are faults, a role that cannot connect tries again after this time."""
ORPHAN_S = 5.0
"""How long a process whose supervisor died gets to end in good order."""
_PR_SET_NAME = 15


@frozen
class MessageFaults:
    """What a role process needs to have message faults; goes to it as an option."""

    rules: tuple[MessageRule, ...]
    board: Path
    """File of the run's `SharedBoard`."""
    word: int
    """This process's word in it."""
    receiver: str
    seed: str

    def wrap(self, core: Core) -> Core:
        """Put the faults before a core."""
        board = BoardWord(self.board, self.word)
        return FaultyCore(core, self.rules, board, receiver=self.receiver, seed=self.seed)


def fork_server() -> ForkServerContext:
    """Return the context whose processes are forked from a server that is ready to drive.

    Linear algebra in every process stays on one thread: many processes share few cores.
    """
    for name in THREAD_LIMITS:
        os.environ.setdefault(name, "1")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([PRELOADED])
    # Ctrl-C reaches the whole process group: the supervisor ends its processes, in order. They
    # inherit that they ignore it, so none is caught unprepared.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        forkserver.ensure_running()
    finally:
        signal.signal(signal.SIGINT, before)
    return context


def start_role(
    context: ForkServerContext,
    role: str,
    name: str,
    tables: dict[str, Any],
    options: dict[str, Any],
) -> ForkServerProcess:
    """Start a role.

    Args:
        context: of `fork_server`.
        role: `router`, `coordinator`, `bridge` or `agent`.
        name: for logs and process lists.
        tables: the scenario, as `to_tables` gives it.
        options: what the role needs beside the scenario; `folder` is where its log goes,
            `temporary` where its temporary files go, `namespace` a process whose network
            namespace it joins, `faults` its `MessageFaults`; the last two may be missing.

    Raises:
        CommandFailedError: the fork server is gone, or no process can be made.
    """
    process = context.Process(target=run_role, args=(role, name, tables, options), name=name)
    try:
        process.start()
    except (EOFError, OSError) as error:
        reason = str(error) or "the fork server is gone"
        raise CommandFailedError(f"cannot start {name}: {reason}") from error
    return process


def run_role(role: str, name: str, tables: dict[str, Any], options: dict[str, Any]) -> None:
    """Run a role in this process until it ends (the target of `start_role`)."""
    die_with_parent()
    if "namespace" in options:
        # A thread belongs to a namespace, not a process: before there are more threads.
        join_namespace(options["namespace"])
    die_with_supervisor()
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)
    tempfile.tempdir = options["temporary"]
    log_to_file(Path(options["folder"]) / "log.jsonl", role, name)
    try:
        while not _run_once(role, name, tables, options):
            time.sleep(CONNECT_AGAIN_S)
    except BadInputError as error:
        log.error("cannot start", reason=str(error))  # noqa: TRY400 (the line says it all)
        sys.exit(2)
    except Exception:
        log.exception("role failed")
        sys.exit(1)


def _run_once(role: str, name: str, tables: dict[str, Any], options: dict[str, Any]) -> bool:
    """Run a role; false when it could not connect because of a fault, and should try again."""
    try:
        _ROLES[role](name, tables, options)
    except BadInputError as error:
        # The router may be down, or the way to it cut. The bridge is never started then.
        if "faults" not in options or role == "bridge" or error.field != "network.endpoint":
            raise
        return False
    return True


def die_with_supervisor() -> None:
    """End this process when the one that ordered it dies, however that dies.

    The fork server, which is the parent, lives on as long as one of its processes does.
    """
    supervisor = multiprocessing.parent_process()
    if supervisor is None:
        return

    parent = os.getppid()

    def watch() -> None:
        supervisor.join()
        if os.getppid() == parent:
            wake_children(parent)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(ORPHAN_S)
        os._exit(1)

    threading.Thread(target=watch, name="supervisor", daemon=True).start()


def wake_children(parent: int) -> None:
    """Let go on what a fault has paused: whoever sleeps does not see that its supervisor died."""
    with contextlib.suppress(OSError):
        children = Path(f"/proc/{parent}/task/{parent}/children").read_text(encoding="ascii")
        for child in children.split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(child), signal.SIGCONT)


def _wrap(options: dict[str, Any]) -> Wrap:
    faults = options.get("faults")
    return bare if faults is None else faults.wrap


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
        options["method"],
        options["pace"],
        _wrap(options),
    )


def _agent(_: str, tables: dict[str, Any], options: dict[str, Any]) -> None:
    from laneweave.agents.process import run_agents

    # Everybody waits for bridge, router and coordinators: they go first.
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
