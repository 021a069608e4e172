"""The coordinator process over Zenoh."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator, Mapping
from functools import partial
from typing import ClassVar

from attrs import frozen

from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.planning.kernels import BRANCHING, ROLLING, BackgroundCompilation
from laneweave.coordinator.planning.solve import plan, prepare
from laneweave.protocol.radio.radio_core import over_radio
from laneweave.protocol.runtime.message_faults import CoreWrapper, unwrapped
from laneweave.protocol.runtime.metrics import (
    MetricsSnapshot,
    Observe,
    Source,
    metric,
    unobserved,
)
from laneweave.protocol.runtime.processes import accepted_stop_signals
from laneweave.protocol.runtime.settings_check import CheckedCore, Process
from laneweave.protocol.runtime.worker_pool import WorkerPool
from laneweave.protocol.scenario.common_settings import settings_of
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import access_of
from laneweave.protocol.transports.zenoh.runner import run_core
from laneweave.protocol.wire.identities import Identity, Incarnations
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.topics import CENSUS, Party


@frozen
class SolverMetrics:
    """Solvers of a coordinator."""

    ABOUT: ClassVar[str] = "solver"

    available: Mapping[str, int] = metric(
        "1 if the solver can be used, 0 if it is not compiled", label="solver"
    )


def run_coordinator(
    scenario: Scenario,
    name: str,
    wrap: CoreWrapper = unwrapped,
    observe: Observe = unobserved,
    *,
    fork_workers: bool = False,
    grace_s: float = 0.0,
) -> None:
    """Run a coordinator candidate until SIGINT or SIGTERM.

    If branching is not compiled, it is compiled in another process, and TAPPA makes all plans until
    then. A candidate of the rolling operation has no other planner, so it first waits for this one.

    Args:
        scenario: road and deployment.
        name: name of the candidate; candidates are ranked by name.
        wrap: wraps the core, to inject faults.
        observe: registers the metrics source.
        fork_workers: whether the planning service forks its worker processes now, with the planner
            loaded, instead of starting new ones at its first request.
        grace_s: time to answer pending requests after the first signal [s].

    Raises:
        BadInputError: no router answers at the scenario's endpoint, or there is no such solver.
        CacheError: the rolling planner cannot be compiled.
    """
    prepare(scenario.formation.solver, "formation.solver")
    with _exits_on_stop_signals():
        if scenario.formation.planner == ROLLING.name:
            ROLLING.load()
        BRANCHING.load_if_compiled()
    workers = scenario.service.workers or max(1, len(os.sched_getaffinity(0)) - 1)
    incarnation = Incarnations()()
    core = CoordinatorCore(
        Name(name),
        incarnation,
        scenario,
        workers=workers,
        plan=partial(plan, compiled_only=True),
    )
    process = Process.of(Identity(Party.COORDINATOR, name), incarnation)
    received = over_radio(core, scenario, Party.COORDINATOR, name)
    checked = CheckedCore(received, process, settings_of(scenario), CENSUS)
    with contextlib.closing(WorkerPool(workers, _load_branching)) as pool:
        if fork_workers:
            pool.fork()  # before the compilation starts a thread
        with contextlib.closing(BackgroundCompilation(BRANCHING)):
            access = access_of(scenario, f"coordinator.{name}")
            observe = partial(_observe_solvers, observe)
            run_core(wrap(checked), access, pool, observe, grace_s=grace_s)


def _load_branching() -> None:
    BRANCHING.load_if_compiled()


def _observe_solvers(observe: Observe, source: Source) -> None:
    """Register a metrics source, with the metrics of the solvers added."""

    def snapshots() -> Iterator[MetricsSnapshot]:
        yield from source()
        yield SolverMetrics({"tappa": 1, BRANCHING.name: int(BRANCHING.loaded)})

    observe(snapshots)


@contextlib.contextmanager
def _exits_on_stop_signals() -> Iterator[None]:
    """Exit with status 0 on a stop signal: there is nothing to complete yet.

    An exception that a signal handler raises in a compiler callback would only be printed, so a
    thread waits for the byte that Python writes when a signal arrives.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    before = {number: signal.signal(number, lambda *_: None) for number in accepted_stop_signals()}
    descriptor = signal.set_wakeup_fd(writer)

    def wait() -> None:
        if os.read(reader, 1):
            os._exit(0)
        os.close(reader)

    threading.Thread(target=wait, name="end", daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(descriptor)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(writer)  # ends the thread
