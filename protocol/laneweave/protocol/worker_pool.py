"""Processes that compute for a core: the shell of its `Delegate` effects.

Each job runs in a process of its own kind, so that one that hangs, or dies, takes nobody with it:
pebble kills a worker whose job is overdue and starts another.
"""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from functools import partial
from typing import Any

import structlog
from pebble import ProcessExpired, ProcessPool

from laneweave.protocol.node import Computed, Delegate, in_time
from laneweave.protocol.processes import die_with_parent

log = structlog.get_logger(__name__)

OVERDUE_S = 5.0
"""A worker that goes on for so long after its job's deadline is killed."""
END_S = 2.0
"""How long the workers' end may take."""


class WorkerPool:
    """Workers of a process; they die with it, however it dies."""

    def __init__(self, workers: int, warm_up: Callable[[], None] | None = None) -> None:
        """Prepare; no process is started before the first job, or `start`.

        Args:
            workers: how many jobs run at a time.
            warm_up: what each worker does when it starts; can be pickled.
        """
        self.workers = workers
        self._pool = ProcessPool(
            max_workers=workers,
            initializer=partial(_begin, warm_up),
            # A fork would take over threads and sockets of the network.
            context=multiprocessing.get_context("spawn"),
        )

    def start(self) -> None:
        """Start the workers now, not with the first job; returns at once."""
        for _ in range(self.workers):
            self._pool.schedule(_nothing)

    def order(self, job: Delegate, done: Callable[[Computed], None]) -> None:
        """Have a job done; `done` is called from a thread of the pool."""
        left_s = job.deadline_s - time.monotonic()
        # The clock of `time.monotonic` is one for all processes of a machine.
        future = self._pool.schedule(
            in_time,
            args=(job.work, job.deadline_s, time.monotonic),
            timeout=max(0.0, left_s) + OVERDUE_S,
        )
        future.add_done_callback(lambda ended: done(_computed(job.job, ended)))

    def close(self) -> None:
        """End the workers at once, whatever they are doing."""
        self._pool.stop()  # type: ignore[no-untyped-call]
        self._pool.join(timeout=END_S)


def _computed(job: int, ended: Future[Any]) -> Computed:
    try:
        return Computed(job, ended.result())
    except CancelledError:
        return Computed(job, None, "the process is ending")
    except TimeoutError as error:
        return Computed(job, None, str(error) or "the worker was stopped: it went on too long")
    except ProcessExpired as error:
        log.warning("a worker died", job=job, status=error.exitcode)
        return Computed(job, None, "the worker died")
    except Exception as error:  # noqa: BLE001 (whatever the work raises is its answer)
        log.warning("computation failed", job=job, reason=f"{type(error).__name__}: {error}")
        return Computed(job, None, f"{type(error).__name__}: {error}")


def _begin(warm_up: Callable[[], None] | None) -> None:
    die_with_parent()
    # Ctrl-C reaches the whole group; the process that has the pool ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if warm_up is not None:
        warm_up()


def _nothing() -> None:
    """Do nothing; a job that has a worker started."""
