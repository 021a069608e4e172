"""The process in which a planner of a user runs.

A planner may exceed its deadline, hang in compiled code or crash, so the process can be killed
without harm to the planning process, which uses the plan of a built-in solver then. It starts with
the first request, or before (`load_planner`), and serves all later ones.
"""

from __future__ import annotations

import atexit
import json
import operator
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Final

import structlog
from attrs import define, field

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.plug_ins.registry import (
    PLANNERS,
    Paths,
    PlainPaths,
    PlanLimits,
    Planner,
    PlannerFailedError,
)
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.protocol.errors import BadInputError, one_line
from laneweave.protocol.runtime.processes import die_with_parent

log = structlog.get_logger(__name__)

START_S: Final = 60.0
"""Maximum time to import a planner."""
OVERDUE_SHARE: Final = 0.2
"""Share of its time by which a planner may exceed it before its process is killed."""
PAUSE_S: Final = 10.0
"""Time after which a planner that was killed is asked again, times the number of times in a row."""
POLL_S: Final = 0.02
NICENESS: Final = 5
"""Increase of the niceness: the processes that all others wait for take priority."""

_PROGRAM: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    f"from {__name__} import serve; serve(int(sys.argv[2]), sys.argv[3], int(sys.argv[4]))"
)


def load_planner(name: str, solver_field: str = "solver") -> None:
    """Start the process of a planner, unless it runs; it imports the planner.

    Raises:
        BadInputError: there is no such planner, or it cannot be loaded.
    """
    _process_of(name).start(solver_field)


def end_planner(name: str) -> None:
    """End the process of a planner, if it runs."""
    _process_of(name).close()


def ask_planner(name: str, request: PlanRequest, limits: PlanLimits, budget: Budget) -> PlainPaths:
    """Return the paths that a planner makes for a request, as tuples of integers.

    Args:
        name: name of the planner.
        request: the request, with targets.
        limits: limits of the planner; its process is killed if it exceeds the deadline by
            `OVERDUE_SHARE`.
        budget: checked while waiting; its exceptions kill the process.

    Raises:
        BadInputError: the planner cannot be loaded.
        PlannerFailedError: the planner returned no paths.
        BudgetSpentError: the budget was spent.
    """
    return _process_of(name).ask(request, limits, budget)


@define(eq=False)
class _PlannerProcess:
    """One planner and its process, which is started again when it has ended."""

    name: str
    _lock: threading.Lock = field(factory=threading.Lock)
    _process: subprocess.Popen[bytes] | None = None
    _connection: Connection | None = None
    _kills: int = 0
    """Number of requests in a row at which the process was killed or died."""
    _resume_s: float = 0.0
    """Time from which on the planner is asked again."""

    def start(self, solver_field: str) -> None:
        """See `load_planner`."""
        PLANNERS.checked(self.name, solver_field)
        with self._lock:
            self._start(solver_field)

    def ask(self, request: PlanRequest, limits: PlanLimits, budget: Budget) -> PlainPaths:
        """See `ask_planner`."""
        with self._lock:
            if time.monotonic() < self._resume_s:
                raise PlannerFailedError("paused, because its process was killed or died")
            connection = self._start("solver")
            try:
                connection.send((request, limits))
                ends_s = time.monotonic() + (1.0 + OVERDUE_SHARE) * limits.deadline_s
                while not (answered := connection.poll(POLL_S)) and time.monotonic() < ends_s:
                    budget.check_time()
                answer = connection.recv() if answered else None
            except (EOFError, OSError):
                raise self._failed("its process died") from None
            except BaseException:
                self.end()
                raise
            if answer is None:
                raise self._failed(f"killed: no answer within {limits.deadline_s:.3g} s")
            self._kills = 0
            paths: PlainPaths | None
            paths, error = answer
            if paths is None:
                raise PlannerFailedError(error)
            return paths

    def _failed(self, reason: str) -> PlannerFailedError:
        """End the process, pause, and return the error."""
        self.end()
        self._kills += 1
        self._resume_s = time.monotonic() + self._kills * PAUSE_S
        return PlannerFailedError(reason)

    def _start(self, solver_field: str) -> Connection:
        """Return the connection to the process, which is started if it does not run."""
        if self._connection is not None and self._process is not None:
            if self._process.poll() is None:
                return self._connection
            self.end()
        ours, theirs = Pipe()
        with theirs:
            descriptor = theirs.fileno()
            arguments = (
                json.dumps(list(map(str, sys.path))),
                str(descriptor),
                self.name,
                str(os.getpid()),
            )
            self._process = subprocess.Popen(  # noqa: S603 (no input from outside)
                [sys.executable, "-c", _PROGRAM, *arguments],
                stdin=subprocess.DEVNULL,
                pass_fds=(descriptor,),
                process_group=0,  # Ctrl-C in a terminal is for the parent
            )
        self._connection = ours
        error = f"it did not load within {START_S:g} s"
        try:
            if ours.poll(START_S):
                error = ours.recv()
        except (EOFError, OSError):
            error = "its process died while it was loaded"
        if error:
            self.end()
            PLANNERS.checked(self.name, solver_field)
            raise BadInputError(solver_field, self.name, f"a planner that can be loaded: {error}")
        return ours

    def close(self) -> None:
        """See `end_planner`."""
        with self._lock:
            self.end()

    def end(self) -> None:
        """Kill the process, if there is one."""
        if self._connection is not None:
            self._connection.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._process = self._connection = None

    def forget(self) -> None:
        """Close the connection of the parent, in a process that was forked from it."""
        if self._connection is not None:
            self._connection.close()


_processes: dict[str, _PlannerProcess] = {}
_processes_lock = threading.Lock()


def _process_of(name: str) -> _PlannerProcess:
    with _processes_lock:
        return _processes.setdefault(name, _PlannerProcess(name))


@atexit.register
def _end_all() -> None:
    for process in _processes.values():
        process.end()


def _after_fork() -> None:
    global _processes_lock  # noqa: PLW0603 (the parent may have held it)
    _processes_lock = threading.Lock()
    for process in _processes.values():
        process.forget()
    _processes.clear()


os.register_at_fork(after_in_child=_after_fork)


# --- in the planner's process -------------------------------------------------------------------


def serve(descriptor: int, name: str, parent: int) -> None:
    """Load a planner and answer requests until the parent ends; main function of the process.

    Args:
        descriptor: file descriptor of the connection to the parent.
        name: name of the planner.
        parent: process id of the parent.
    """
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    os.dup2(2, 1)  # stdout belongs to the command
    connection = Connection(descriptor)
    try:
        planner: Planner = PLANNERS.load(name, "solver")
        error = "" if callable(planner) else f"{type(planner).__name__} is not callable"
    except BadInputError as failure:
        error = failure.allowed
    connection.send(error)
    described = False
    while not error:
        try:
            request, limits = connection.recv()
        except EOFError:
            return
        try:
            paths = _plain(planner(request, limits))
            reason = "it returned no paths" if paths is None else ""
        except Exception as failure:  # noqa: BLE001 (whatever a plug-in raises)
            paths, reason = None, one_line(f"{type(failure).__name__}: {failure}")
            if not described:  # once: authors need the traceback, logs do not
                traceback.print_exc()
                described = True
        connection.send((paths, reason))


def _plain(paths: Paths | None) -> PlainPaths | None:
    """Return paths as tuples of integers, which the parent can read without the plug-in's types."""
    if paths is None:
        return None
    index = operator.index
    return tuple(tuple((index(column), index(lane)) for column, lane in path) for path in paths)
