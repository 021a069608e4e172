"""Worker processes that run the `Delegate` effects of a core.

One thread per worker passes the next job to its process and waits for the result, for the death of
the process, or until the job is long overdue. In the last two cases the process is replaced, and
only that job fails. (The pools of the standard library and of pebble break down as a whole when an
idle worker is killed.)
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import queue
import signal
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

import structlog

from laneweave.protocol.runtime.node import Computed, Delegate, error_text, run_delegated
from laneweave.protocol.runtime.processes import die_with_parent

log = structlog.get_logger(__name__)

OVERDUE_S = 5.0
"""A worker that exceeds its job's deadline by this time is killed."""
END_S = 2.0
"""Longest wait for the end of a killed process."""
CHECK_S = 1.0
"""Interval at which an idle thread checks that its process is alive."""
PAUSE_S = 0.5
"""Delay before the replacement of a process that died this soon after its start, so that one that
cannot start does not keep the machine busy."""

# A fork would take over threads and sockets of the network.
_CONTEXT = multiprocessing.get_context("spawn")
_Order = tuple[Delegate, Callable[[Computed], None]]


class WorkerPool:
    """Workers of a process; they die with it."""

    def __init__(self, workers: int, warm_up: Callable[[], None] | None = None) -> None:
        """Prepare; processes start with the first job, or with `start`.

        Args:
            workers: number of jobs that run at a time.
            warm_up: picklable function that each worker calls at its start.
        """
        self._orders: queue.SimpleQueue[_Order | None] = queue.SimpleQueue()
        self._workers = [_Worker(self._orders, warm_up) for _ in range(workers)]
        self._started = False

    @property
    def process_ids(self) -> list[int]:
        """Ids of the running processes."""
        return [worker.process_id for worker in self._workers if worker.process_id]

    def start(self) -> None:
        """Start the workers now; return at once."""
        if not self._started:
            self._started = True
            for worker in self._workers:
                worker.thread.start()

    def submit(self, job: Delegate, done: Callable[[Computed], None]) -> None:
        """Queue a job; `done` is called from a thread."""
        self.start()
        self._orders.put((job, done))

    def close(self) -> None:
        """End the workers at once; results of their jobs are discarded."""
        for worker in self._workers:
            worker.end()
        for _ in self._workers:
            self._orders.put(None)
        if self._started:
            for worker in self._workers:
                worker.thread.join(END_S)


class _Worker:
    """One process at a time, and the thread that manages it."""

    def __init__(
        self, orders: queue.SimpleQueue[_Order | None], warm_up: Callable[[], None] | None
    ) -> None:
        self._orders = orders
        self._warm_up = warm_up
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None
        self._begun_s = -math.inf
        self.thread = threading.Thread(target=self._look_after, name="worker", daemon=True)

    @property
    def process_id(self) -> int:
        """Id of the process; 0 if there is none."""
        process = self._process
        return 0 if process is None or process.pid is None else process.pid

    def end(self) -> None:
        """Kill the process and end the thread."""
        with self._lock:
            self._ending.set()
            process = self._process  # the thread may let go of it meanwhile
            if process is not None:
                process.kill()

    def _look_after(self) -> None:
        self._begin()
        while not self._ending.is_set():
            try:
                order = self._orders.get(timeout=CHECK_S)
            except queue.Empty:
                if self._process is None or not self._process.is_alive():
                    self._begin()
                continue
            if order is None:
                break
            job, done = order
            try:
                result = self._do(job)
            except Exception as error:
                # The thread must go on, or a share of the requests would wait forever.
                log.exception("a worker is replaced after an error", job=job.job)
                self._forget()
                result = Computed(job.job, None, error_text(error))
            if not self._ending.is_set():
                done(result)
                if self._connection is None:
                    self._begin()
        self._forget()

    def _begin(self) -> Connection | None:
        """Start a process, replacing the previous one.

        Returns:
            The connection to it; None if the pool is ending or the process cannot be started.
        """
        self._forget()
        if time.monotonic() < self._begun_s + PAUSE_S:
            self._ending.wait(PAUSE_S)
        with self._lock:
            if self._ending.is_set():
                return None
            self._begun_s = time.monotonic()
            try:
                self._process, self._connection = _start(self._warm_up)
            except OSError as error:
                log.warning("a worker cannot be started", reason=str(error))
            return self._connection

    def _forget(self) -> None:
        """Kill the process, if any, and close its connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self._process is not None:
            self._process.kill()
            self._process.join(END_S)
            self._process = None

    def _do(self, job: Delegate) -> Computed:
        """Run a job; retry once in a new process if the worker dies."""
        for _ in range(2):
            connection = self._connection or self._begin()
            done = None if connection is None else self._try(connection, job)
            if done is not None:
                return done
            self._forget()
            if not self._ending.is_set():
                log.warning("a worker died", job=job.job)
        return Computed(job.job, None, "the worker died")

    def _try(self, connection: Connection, job: Delegate) -> Computed | None:
        """Return the result of a job; None if the process died."""
        left_s = max(0.0, job.deadline_s - time.monotonic())
        try:
            connection.send(job)
            # A new process warms up first; its pipe has room for a job.
            if connection.poll(left_s + OVERDUE_S):
                result, error = connection.recv()
                return Computed(job.job, result, error)
        except (EOFError, OSError):
            return None
        except Exception as error:
            # It cannot be pickled. The pipe carries whole messages, so nothing of it is left there.
            log.exception("a job or its result cannot be handed over", job=job.job)
            return Computed(job.job, None, error_text(error))
        self._forget()
        log.warning("a worker was stopped: it went on too long", job=job.job)
        return Computed(job.job, None, "the worker was stopped: it went on too long")


def _start(warm_up: Callable[[], None] | None) -> tuple[SpawnProcess, Connection]:
    ours, theirs = _CONTEXT.Pipe()
    with theirs:
        process = _CONTEXT.Process(target=_work, args=(theirs, warm_up), name="worker", daemon=True)
        try:
            process.start()
        except OSError:
            ours.close()
            raise
    return process, ours


def _work(connection: Connection, warm_up: Callable[[], None] | None) -> None:
    """Run jobs until the other end is closed: the main function of a worker process."""
    die_with_parent()
    # Ctrl-C reaches the whole process group; the owner of the pool ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if warm_up is not None:
        warm_up()
    with contextlib.suppress(EOFError, OSError):
        while True:
            _do_next(connection)


def _do_next(connection: Connection) -> None:
    """Run one job.

    Raises:
        EOFError, OSError: the other end is closed.
    """
    try:
        # All processes of a machine share the clock of `time.monotonic`.
        computed = run_delegated(connection.recv(), time.monotonic)
        connection.send((computed.result, computed.error))
    except (EOFError, OSError):
        raise
    except Exception as error:  # it cannot be pickled
        log.exception("a job or its result cannot be handed over")
        connection.send((None, error_text(error)))
