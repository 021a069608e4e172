"""Worker processes that run the `Delegate` effects of a core.

One thread per worker sends the next job to its process and waits until the result arrives, the
process dies, or the deadline has been exceeded by `OVERDUE_S`. In the last two cases the process is
replaced (`fork_server`); no other job is affected. (The pools of the standard library and of pebble
fail completely when an idle worker is killed.)

A job is stopped through its clock: the number of the job to stop is in memory that the pool shares
with the process, and the clock compares it at each reading. A process whose job does not end within
`STOP_S` is replaced, which takes less time than many planners need to read the clock, or to free
their memory.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import multiprocessing
import os
import queue
import threading
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection

import structlog
from attrs import define

from laneweave.protocol.runtime.fork_server import END_S, ForkServer
from laneweave.protocol.runtime.node import (
    STOPPED,
    Clock,
    Computed,
    Delegate,
    StoppedError,
    error_text,
    run_delegated,
)

log = structlog.get_logger(__name__)

OVERDUE_S = 5.0
"""Time by which a worker may exceed the deadline of its job before it is killed."""
STOP_S = 0.05
"""Time after which a worker is replaced if its job does not stop."""
NICENESS = 5
"""Increase of a worker's niceness: the processes that all others wait for take priority."""
CHECK_S = 1.0
"""Interval at which an idle thread checks that its process is alive."""
PAUSE_S = 0.5
"""Delay before replacing a process that died by itself within this time of its start, so that
repeated failures do not load the machine."""


@define(eq=False)
class _Order:
    """A job, from `submit` until its result."""

    job: Delegate
    done: Callable[[Computed], None]
    stopped: bool = False


class WorkerPool:
    """Pool of worker processes, which die with their parent."""

    def __init__(self, workers: int, warm_up: Callable[[], object] | None = None) -> None:
        """Create the pool; processes start at the first call of `submit` or `fork`.

        Args:
            workers: maximum number of concurrent jobs.
            warm_up: picklable function that loads what jobs need; see `ForkServer`.
        """
        self._queue: queue.SimpleQueue[_Order | None] = queue.SimpleQueue()
        # Shared memory of any start method.
        jobs_to_stop = multiprocessing.get_context("spawn").RawArray(ctypes.c_int64, workers)
        jobs_to_stop[:] = [-1] * workers
        self._server = ForkServer(workers, partial(_work, jobs_to_stop), warm_up)
        self._workers = [
            _Worker(number, self._queue, self._server, jobs_to_stop) for number in range(workers)
        ]
        self._orders: dict[int, _Order] = {}
        """Orders without a result, by the number of the job."""
        self._started = False

    @property
    def process_ids(self) -> list[int]:
        """Process ids of the running workers."""
        return self._server.process_ids

    def fork(self) -> None:
        """Start the workers as forks of this process, which has loaded what they need.

        Must be called before this process opens Zenoh, and before `submit`; see `ForkServer.start`.
        """
        self._start(fork=True)

    def _start(self, *, fork: bool = False) -> None:
        if not self._started:
            self._started = True
            with contextlib.suppress(OSError):  # tried again, and reported, for each worker
                self._server.start(fork=fork)
            for worker in self._workers:
                worker.thread.start()

    def submit(self, job: Delegate, done: Callable[[Computed], None]) -> None:
        """Queue a job; `done` is called from a worker's thread."""
        self._start()

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
        self._server.close()
        for _ in self._workers:
            self._queue.put(None)
        if self._started:
            for worker in self._workers:
                worker.thread.join(END_S)


class _Worker:
    """A thread that manages one process at a time."""

    def __init__(
        self,
        number: int,
        orders: queue.SimpleQueue[_Order | None],
        server: ForkServer,
        jobs_to_stop: ctypes.Array[ctypes.c_int64],
    ) -> None:
        self._number = number
        self._orders = orders
        self._server = server
        self._order: _Order | None = None
        """Current order."""
        self._jobs_to_stop = jobs_to_stop
        """Number of the newest job to stop of each worker, in shared memory."""
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._connection: Connection | None = None
        self._started_s = -math.inf
        """Start of the process, unless the pool has killed it."""
        self.thread = threading.Thread(target=self._run_jobs, name="worker", daemon=True)

    def end(self) -> None:
        """End the thread when the process has exited."""
        with self._lock:
            self._ending.set()

    def stop(self, order: _Order) -> None:
        """Stop an order if it is the current one; kill the process if that takes too long."""
        if self._order is order:
            self._jobs_to_stop[self._number] = order.job.job
            timer = threading.Timer(STOP_S, self._kill_if_running, (order,))
            timer.daemon = True
            timer.start()

    def _kill_if_running(self, order: _Order) -> None:
        with self._lock:
            if self._order is order and not self._ending.is_set():
                log.info("a worker is replaced: its job did not stop", job=order.job.job)
                self._started_s = -math.inf
                self._server.kill(self._number)

    def _run_jobs(self) -> None:
        self._start_process()
        while not self._ending.is_set():
            try:
                order = self._orders.get(timeout=CHECK_S)
            except queue.Empty:
                if self._connection is None or self._connection.poll():  # the end of the process
                    self._start_process()
                continue
            if order is None:
                break
            result = self._result_of(order)
            if not self._ending.is_set():
                order.done(result)
                if self._connection is None:
                    self._start_process()
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

    def _start_process(self) -> Connection | None:
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
                self._connection = self._server.fork(self._number)
            except OSError as error:
                log.warning("a worker cannot be started", reason=str(error))
            return self._connection

    def _discard_process(self) -> None:
        """Kill the process if there is one, and close its connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
            self._server.kill(self._number)

    def _run(self, order: _Order) -> Computed:
        """Run a job unless it is stopped; retry once in a new process if the worker dies."""
        job = order.job
        for _ in range(2):
            if order.stopped:
                return Computed(job.job, None, STOPPED)
            connection = self._connection or self._start_process()
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


def _work(jobs_to_stop: ctypes.Array[ctypes.c_int64], number: int, connection: Connection) -> None:
    """Run jobs until the parent closes its connection; main function of a worker process."""
    os.nice(NICENESS)
    with contextlib.suppress(EOFError, OSError):
        while True:
            _run_next(jobs_to_stop, number, connection)


def _run_next(
    jobs_to_stop: ctypes.Array[ctypes.c_int64], number: int, connection: Connection
) -> None:
    """Run one job.

    Raises:
        EOFError, OSError: the parent has closed its connection.
    """
    try:
        # `time.monotonic` reads the same clock in all processes of a machine.
        job = connection.recv()
        clock = _stoppable_clock(job.job, number, jobs_to_stop)
        computed = run_delegated(job, time.monotonic, clock)
        connection.send((computed.result, computed.error))
    except (EOFError, OSError):
        raise
    except Exception as error:  # pickling failed
        log.exception("a job or its result cannot be transferred")
        connection.send((None, error_text(error)))


def _stoppable_clock(job: int, number: int, jobs_to_stop: ctypes.Array[ctypes.c_int64]) -> Clock:
    """Return `time.monotonic`, except that it raises `StoppedError` when the job is to stop."""

    def clock() -> float:
        if jobs_to_stop[number] == job:
            raise StoppedError
        return time.monotonic()

    return clock
