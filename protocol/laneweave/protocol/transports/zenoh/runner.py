"""Runner of a core over Zenoh in real time, for all roles."""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import structlog

from laneweave.protocol.runtime.inbox import Inbox, Item
from laneweave.protocol.runtime.metrics import Observe, SnapshotRequest, snapshot_source, unobserved
from laneweave.protocol.runtime.node import (
    Compute,
    Computed,
    Core,
    Delegate,
    Node,
    Started,
    StopJob,
    StoppedError,
    Stopping,
    Wakeup,
    run_job,
)
from laneweave.protocol.runtime.processes import stop_signals
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.transport import connect
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.topics import Keys

if TYPE_CHECKING:
    from laneweave.protocol.runtime.worker_pool import WorkerPool

log = structlog.get_logger(__name__)

SWITCH_S = 1e-4
"""Maximum time [s] for which Zenoh's thread waits for the interpreter lock; Python's own is 5 ms.

With the default, a flood of messages that are refused lets hardly any others in."""
ONE_SIGNAL_S = 0.2
"""Time in which stop signals are one: `timeout` and shells send each of them twice."""
WORKER_END_S = 5.0
"""Maximum time to wait for the end of a computation that has been stopped."""


def run_core(
    core: Core,
    access: Access,
    pool: WorkerPool | None = None,
    observe: Observe = unobserved,
    *,
    grace_s: float = 0.0,
) -> None:
    """Run a core over Zenoh until it ends or the process receives SIGINT or SIGTERM.

    With a grace, the core ends itself after the first signal; after the second one it ends at once.

    Must be called in the main thread. `Compute` jobs run in a thread, `Delegate` jobs in `pool`,
    which only a core that delegates needs. `observe` registers the metrics of the node and core.

    Raises:
        BadInputError: the realm is malformed, or no router answers at the endpoint within
            `connect_timeout_s`.
    """
    sys.setswitchinterval(SWITCH_S)
    keys = Keys(access.realm)
    inbox = Inbox()
    stops = stop_signals(_StopSignals(inbox.put, grace_s))
    with stops, contextlib.closing(_Worker(inbox.put)) as worker:

        def submit(job: Compute | Delegate | StopJob) -> None:
            if isinstance(job, Compute):
                worker.submit(job)
            elif pool is None:
                inbox.put(Computed(job.job, None, "this process has no workers"))
            elif isinstance(job, Delegate):
                pool.submit(job, inbox.put)
            else:
                pool.stop(job.job)

        # Until the process is connected, the inbox can contain only `Stopping`.
        transport = connect(access, inbox.put, lambda wait_s: any(inbox.take(wait_s)))
        if transport is None:
            return
        node = Node(core, transport, keys, submit, Name(f"{os.getpid()}-{time.time_ns()}"))
        observe(snapshot_source(inbox.put))
        try:
            node.dispatch(Started(), time.monotonic())
            while not node.ended:
                _step(node, inbox)
        finally:
            transport.close()


def _step(node: Node, inbox: Inbox) -> None:
    wakeup_s = node.core.wakeup_s
    timeout_s = 1.0 if wakeup_s is None else min(1.0, max(0.0, wakeup_s - time.monotonic()))
    for item in inbox.take(timeout_s):
        _handle(node, item)
    now_s = time.monotonic()
    wakeup_s = node.core.wakeup_s
    if wakeup_s is not None and wakeup_s <= now_s:
        node.dispatch(Wakeup(), now_s)
        node.handling_s += time.monotonic() - now_s


def _handle(node: Node, item: Item) -> None:
    now_s = time.monotonic()
    if isinstance(item, Stopping):
        log.info("stopping", grace_s=item.grace_s)
        node.dispatch(item, now_s)
        node.ended = node.ended or not item.grace_s
    elif isinstance(item, SnapshotRequest):
        item.answer(node.metrics())
    elif isinstance(item, Computed):
        node.dispatch(item, now_s)
    else:
        node.deliver(item, now_s)
    node.handling_s += time.monotonic() - now_s


class _StopSignals:
    """Handler of stop signals: the first one grants the grace, the next one does not."""

    def __init__(self, put: Callable[[Stopping], None], grace_s: float) -> None:
        self._put = put
        self._grace_s = grace_s
        self._first_s: float | None = None

    def __call__(self) -> None:
        now_s = time.monotonic()
        if self._first_s is None:
            self._first_s = now_s
            self._put(Stopping(self._grace_s))
        elif now_s >= self._first_s + ONE_SIGNAL_S:
            self._put(Stopping())


class _Worker:
    """Thread for computations, started when the first one is submitted.

    It must end before the interpreter does, which aborts the process if a thread is then in
    compiled code (measured: `numpy.unique`).
    """

    def __init__(self, done: Callable[[Computed], None]) -> None:
        """Create the worker; `done` is called from its thread."""
        self._done = done
        self._jobs: queue.SimpleQueue[Compute | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._closed = False

    def submit(self, job: Compute) -> None:
        """Queue a job."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="compute", daemon=True)
            self._thread.start()
        self._jobs.put(job)

    def close(self) -> None:
        """Stop the computation when it reads its clock, discard those that wait, end the thread."""
        self._closed = True
        self._jobs.put(None)
        if self._thread is not None:
            self._thread.join(WORKER_END_S)

    def _clock(self) -> float:
        if self._closed:
            raise StoppedError
        return time.monotonic()

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None and not self._closed:
            self._done(run_job(job, self._clock))
