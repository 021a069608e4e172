"""Worker processes that run the `Delegate` effects of a core.

One thread per worker sends the next job to its process and waits until the result arrives, the
process dies, or the deadline has been exceeded by `OVERDUE_S`. In the last two cases the process is
replaced; no other job is affected. (The pools of the standard library and of pebble fail completely
when an idle worker is killed.)

A job is stopped through its clock: the number of the job to stop is in memory that the pool shares
with the process, and the clock compares it at each reading. A process whose job does not read the
clock within `STOP_S` is killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import ForkContext, SpawnContext
from multiprocessing.process import BaseProcess

import structlog
from attrs import define

from laneweave.protocol.runtime.node import (
    STOPPED,
    Clock,
    Computed,
    Delegate,
    StoppedError,
    error_text,
    run_delegated,
)
from laneweave.protocol.runtime.processes import die_with_parent

log = structlog.get_logger(__name__)

OVERDUE_S = 5.0
"""Time by which a worker may exceed the deadline of its job before it is killed."""
STOP_S = 0.5
"""Time after which a worker is killed if its job does not stop."""
NICENESS = 5
"""Increase of a worker's niceness: the processes that all others wait for take priority."""
END_S = 2.0
"""Maximum wait for a killed process to exit."""
CHECK_S = 1.0
"""Interval at which an idle thread checks that its process is alive."""
PAUSE_S = 0.5
"""Delay before replacing a process that died within this time of its start, so that repeated
failures do not load the machine."""

_SPAWN = multiprocessing.get_context("spawn")
_FORK = multiprocessing.get_context("fork")


@define(eq=False)
class _Order:
    """A job, from `submit` until its result."""

    job: Delegate
    done: Callable[[Computed], None]
    stopped: bool = False


class WorkerPool:
    """Pool of worker processes, which die with their parent."""

    def __init__(self, workers: int, warm_up: Callable[[], None] | None = None) -> None:
        """Create the pool; processes start at the first call of `submit` or `fork`.

        Args:
            workers: maximum number of concurrent jobs.
            warm_up: picklable function that each worker calls when it starts, unless it is a fork.
        """
        self._queue: queue.SimpleQueue[_Order | None] = queue.SimpleQueue()
        self._workers = [_Worker(self._queue, warm_up) for _ in range(workers)]
        self._orders: dict[int, _Order] = {}
        """Orders without a result, by the number of the job."""
        self._started = False

    @property
    def process_ids(self) -> list[int]:
        """Process ids of the running workers."""
        return [worker.process_id for worker in self._workers if worker.process_id]

    def fork(self) -> None:
        """Start the workers as forks of this process, which must have called `warm_up`.

        Must be called before this process opens Zenoh, and before `submit`: a fork would inherit
        the sockets and locked state of Zenoh. Workers that replace others are not forks.
        """
        for worker in self._workers:
            worker.start_process(_FORK)
        self._start_threads()

    def _start_threads(self) -> None:
        if not self._started:
            self._started = True
            for worker in self._workers:
                worker.thread.start()

    def submit(self, job: Delegate, done: Callable[[Computed], None]) -> None:
        """Queue a job; `done` is called from a worker's thread."""
        self._start_threads()

        def finish(computed: Computed) -> None:
            self._orders.pop(computed.job, None)
            done(computed)

        order = self._orders[job.job] = _Order(job, finish)
        self._queue.put(order)

    def stop(self, job: int) -> None:
        """Stop a job, or do not begin it; its result then has the error `STOPPED`.

        Complete and unknown jobs are ignored.
        """
        order = self._orders.get(job)
        if order is not None:
            order.stopped = True
            for worker in self._workers:
                worker.stop(order)

    def close(self) -> None:
        """Kill the workers and discard the results of their jobs."""
        for worker in self._workers:
            worker.end()
        for _ in self._workers:
            self._queue.put(None)
        if self._started:
            for worker in self._workers:
                worker.thread.join(END_S)


class _Worker:
    """A thread that manages one process at a time."""

    def __init__(
        self, orders: queue.SimpleQueue[_Order | None], warm_up: Callable[[], None] | None
    ) -> None:
        self._orders = orders
        self._order: _Order | None = None
        """Current order."""
        self._job_to_stop = _SPAWN.RawValue(ctypes.c_int64, -1)
        """Number of the newest job to stop, in shared memory."""
        self._warm_up = warm_up
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._process: BaseProcess | None = None
        self._connection: Connection | None = None
        self._started_s = -math.inf
        self.thread = threading.Thread(target=self._run_jobs, name="worker", daemon=True)

    @property
    def process_id(self) -> int:
        """Process id; 0 if there is no process."""
        process = self._process
        return 0 if process is None or process.pid is None else process.pid

    def end(self) -> None:
        """Kill the process and end the thread."""
        with self._lock:
            self._ending.set()
            process = self._process  # the thread may reset it concurrently
            if process is not None:
                process.kill()

    def stop(self, order: _Order) -> None:
        """Stop an order if it is the current one; kill the process if that takes too long."""
        if self._order is order:
            self._job_to_stop.value = order.job.job
            timer = threading.Timer(STOP_S, self._kill_if_running, (order,))
            timer.daemon = True
            timer.start()

    def _kill_if_running(self, order: _Order) -> None:
        with self._lock:
            process = self._process
            if self._order is order and process is not None:
                log.warning("a worker was killed: its job did not stop", job=order.job.job)
                process.kill()

    def _run_jobs(self) -> None:
        if self._process is None:
            self.start_process()
        while not self._ending.is_set():
            try:
                order = self._orders.get(timeout=CHECK_S)
            except queue.Empty:
                if self._process is None or not self._process.is_alive():
                    self.start_process()
                continue
            if order is None:
                break
            result = self._result_of(order)
            if not self._ending.is_set():
                order.done(result)
                if self._connection is None:
                    self.start_process()
        self._discard_process()

    def _result_of(self, order: _Order) -> Computed:
        job = order.job
        self._order = order  # before `stopped` is read, so that `stop` sees one or the other
        try:
            return self._run(order)
        except Exception as error:
            # If the thread ended, jobs could wait forever.
            log.exception("a worker is replaced after an error", job=job.job)
            self._discard_process()
            return Computed(job.job, None, error_text(error))
        finally:
            with self._lock:
                self._order = None

    def start_process(self, context: SpawnContext | ForkContext = _SPAWN) -> Connection | None:
        """Start a process, replacing the previous one.

        Returns:
            The connection to the new process; None if the pool is closing or the start fails.
        """
        self._discard_process()
        if time.monotonic() < self._started_s + PAUSE_S:
            self._ending.wait(PAUSE_S)
        with self._lock:
            if self._ending.is_set():
                return None
            self._started_s = time.monotonic()
            try:
                warm_up = self._warm_up if context is _SPAWN else None
                self._process, self._connection = _start(context, warm_up, self._job_to_stop)
            except OSError as error:
                log.warning("a worker cannot be started", reason=str(error))
            return self._connection

    def _discard_process(self) -> None:
        """Kill the process if there is one, and close its connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self._process is not None:
            self._process.kill()
            self._process.join(END_S)
            self._process = None

    def _run(self, order: _Order) -> Computed:
        """Run a job unless it is stopped; retry once in a new process if the worker dies."""
        job = order.job
        for _ in range(2):
            if order.stopped:
                return Computed(job.job, None, STOPPED)
            connection = self._connection or self.start_process()
            done = None if connection is None else self._try_once(connection, job)
            if done is not None:
                return done
            self._discard_process()
            if not (self._ending.is_set() or order.stopped):
                log.warning("a worker died", job=job.job)
        return Computed(job.job, None, STOPPED if order.stopped else "the worker died")

    def _try_once(self, connection: Connection, job: Delegate) -> Computed | None:
        """Return the result of a job; None if the process died."""
        left_s = max(0.0, job.deadline_s - time.monotonic())
        try:
            connection.send(job)
            # A new process warms up first; meanwhile the pipe holds the job.
            if connection.poll(left_s + OVERDUE_S):
                result, error = connection.recv()
                return Computed(job.job, result, error)
        except (EOFError, OSError):
            return None
        except Exception as error:
            # Pickling failed. The pipe transfers only complete messages, so it is still usable.
            log.exception("a job or its result cannot be transferred", job=job.job)
            return Computed(job.job, None, error_text(error))
        self._discard_process()
        log.warning("a worker was killed: it exceeded its deadline", job=job.job)
        return Computed(job.job, None, "the worker was killed: it exceeded its deadline")


def _start(
    context: SpawnContext | ForkContext,
    warm_up: Callable[[], None] | None,
    job_to_stop: ctypes.c_int64,
) -> tuple[BaseProcess, Connection]:
    ours, theirs = context.Pipe()
    with theirs:
        arguments = theirs, warm_up, job_to_stop
        process = context.Process(target=_work, args=arguments, name="worker", daemon=True)
        try:
            process.start()
        except OSError:
            ours.close()
            raise
    return process, ours


def _work(
    connection: Connection, warm_up: Callable[[], None] | None, job_to_stop: ctypes.c_int64
) -> None:
    """Run jobs until the parent closes its connection; main function of a worker process."""
    # These signals reach the whole process group, but the parent stops its workers itself.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.nice(NICENESS)
    parent = multiprocessing.parent_process()
    die_with_parent(None if parent is None else parent.pid)
    if warm_up is not None:
        warm_up()
    with contextlib.suppress(EOFError, OSError):
        while True:
            _run_next(connection, job_to_stop)


def _run_next(connection: Connection, job_to_stop: ctypes.c_int64) -> None:
    """Run one job.

    Raises:
        EOFError, OSError: the parent has closed its connection.
    """
    try:
        # `time.monotonic` reads the same clock in all processes of a machine.
        job = connection.recv()
        computed = run_delegated(job, time.monotonic, _stoppable_clock(job.job, job_to_stop))
        connection.send((computed.result, computed.error))
    except (EOFError, OSError):
        raise
    except Exception as error:  # pickling failed
        log.exception("a job or its result cannot be transferred")
        connection.send((None, error_text(error)))


def _stoppable_clock(job: int, job_to_stop: ctypes.c_int64) -> Clock:
    """Return `time.monotonic`, except that it raises `StoppedError` when the job is to stop."""

    def clock() -> float:
        if job_to_stop.value == job:
            raise StoppedError
        return time.monotonic()

    return clock
