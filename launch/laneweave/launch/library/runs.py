"""Runs on this machine: over processes, in virtual time, or of a reference method."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

from laneweave.agents.driving.trajectory import check_moves
from laneweave.coordinator.planning.solve import prepare
from laneweave.launch.faults.fault_file import FaultSource, load_faults
from laneweave.launch.report.report import draw_report
from laneweave.launch.run.local_run import LocalRun, StartPage
from laneweave.launch.run.logs import log_by_default
from laneweave.launch.run.outcome import Outcome
from laneweave.launch.run.reference_run import ReferenceRun
from laneweave.launch.run.roles import tuned_garbage_collector
from laneweave.launch.run.run_folder import new_folder
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.launch.run_methods import FORMATION, checked_method, reference_method
from laneweave.protocol.config import scenario_files
from laneweave.protocol.config.participants import coordinator_names
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.scenario.deployment_fields import check_pace
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import RunSummary
from laneweave.sim_bridge.road_sources import demand_of

ZENOH: Final = "zenoh"
SIMULATED: Final = "simulated"
Transport = Literal["zenoh", "simulated"]
ScenarioSource = Scenario | Mapping[str, Any] | Path | str | None
"""A scenario, its tables as nested mappings, the path of a TOML file, or None: the defaults."""

_in_process = threading.Lock()
"""Held by a run in this process: libsumo has one simulation per process."""


def _ignore(_: str) -> None:
    pass


class RunFailedError(CommandFailedError):
    """A run failed, or violated a guarantee; its files are in `folder`."""

    def __init__(self, outcome: Outcome) -> None:
        """Store the outcome."""
        super().__init__(f"{outcome.folder}: {'; '.join(outcome.problems)}")
        self.folder = outcome.folder
        self.problems = outcome.problems
        """Reasons, one line each."""
        self.summary = outcome.summary
        """Summary; None if the run wrote none."""


def load_scenario(source: ScenarioSource = None, **overrides: object) -> Scenario:
    """Return a scenario: the defaults, or those of a file, with some values replaced.

        laneweave.load_scenario("scenarios/demo.toml", seed=3, demand__volume_veh_per_lane_h=1600)

    Args:
        source: path of a TOML file, tables as nested mappings, or a scenario; None: the defaults,
            which are the paper's road.
        **overrides: values of fields, by `field` or `table__field`; None keeps the value.

    Raises:
        BadInputError: the file cannot be read, or a value is unknown, invalid, or contradicts
            others.
    """
    if source is None or isinstance(source, str | Path):
        path = None if source is None else Path(source)
        return scenario_files.load_scenario(path, **overrides)
    tables = scenario_files.to_tables(source) if isinstance(source, Scenario) else source
    return scenario_files.scenario_of(tables, **overrides)


def run(
    scenario: ScenarioSource = None,
    *,
    out: Path | str | None = None,
    method: str = FORMATION,
    transport: Transport | None = None,
    faults: FaultSource = None,
    pace: float | None = None,
    report: bool = False,
    show_progress: bool = False,
    **overrides: object,
) -> RunSummary:
    """Run a scenario to its end and return its summary.

        summary = laneweave.run("scenarios/demo.toml", transport="simulated", out="runs/first")
        print(summary.travel_time_s.mean, summary.safety.overlaps)

    Read the trajectories with `load_run`. At most one run at a time is possible in a process with
    `transport="simulated"` or a reference method; over Zenoh, all roles are other processes.

    Args:
        scenario: see `load_scenario`.
        out: new or empty folder for the results; None: a new one in runs/ (`summary.folder`).
        method: `formation`, `rule`, `lc2013`, or the name of a plug-in (`laneweave.methods`).
        transport: `zenoh` (default): router, coordinators, bridge and agents are processes on this
            machine; `simulated`: in this process, in virtual time, equal results for equal seeds.
        faults: name of a preset, path of a fault file, or its tables as nested mappings
            (docs/FAULTS.md).
        pace: mean road seconds per second; None: `runtime.max_pace`. Only over Zenoh.
        report: whether to draw the figures and `report.html`, as `laneweave run` does.
        show_progress: whether to show a progress bar on stderr.
        **overrides: see `load_scenario`.

    Raises:
        BadInputError: an argument or a value of the scenario is invalid.
        RunFailedError: the run failed, or violated a guarantee.
        KeyboardInterrupt: a signal has ended the run; its files are complete up to then.
        CommandFailedError: the run could not be started.
    """
    log_by_default()
    outcome = perform_run(
        load_scenario(scenario, **overrides),
        out=None if out is None else Path(out),
        method=method,
        transport=transport,
        faults=faults,
        pace=pace,
        show_progress=show_progress,
    ).or_interrupt()
    if outcome.problems or outcome.summary is None:
        raise RunFailedError(outcome)
    if report:
        draw_report(outcome.folder)
    return outcome.summary


def perform_run(
    scenario: Scenario,
    *,
    out: Path | None = None,
    method: str = FORMATION,
    transport: str | None = None,
    faults: FaultSource = None,
    pace: float | None = None,
    show_progress: bool = False,
    announce: Callable[[str], None] = _ignore,
    warn: Callable[[str], None] = _ignore,
    start_page: StartPage | None = None,
) -> Outcome:
    """Run a scenario to its end and return its outcome; see `run`.

    Over Zenoh, `announce` is called with the endpoint of the router, and `warn` with a line if the
    run is slower than real time; `start_page` starts the live page.

    Raises:
        BadInputError: an argument is invalid, or does not fit the scenario.
        CommandFailedError: the run could not be started.
    """
    _check_arguments(method, transport, faults, pace)
    if method == FORMATION:
        local = partial(
            LocalRun,
            show_progress=show_progress,
            pace=pace,
            announce=announce,
            warn=warn,
            start_page=start_page,
        )
        return _run_formations(scenario, out, transport, faults, local, show=show_progress)
    if scenario.sumo.config:
        raise BadInputError("method", method, "formation, with a SUMO simulation")
    reference_method(method).check(scenario)
    with _only_run(), new_folder(out, scenario, method) as folder:
        return ReferenceRun(scenario, folder, method, show_progress=show_progress).run()


def _check_arguments(
    method: str, transport: str | None, faults: FaultSource, pace: float | None
) -> None:
    checked_method(method, "method")
    if transport not in (None, ZENOH, SIMULATED):
        raise BadInputError("transport", transport, f"{ZENOH} or {SIMULATED}")
    check_pace(pace, "pace")
    if pace is not None and transport == SIMULATED:
        raise BadInputError("pace", pace, f"none with transport {SIMULATED}")
    if method != FORMATION:
        for name, value in (("transport", transport), ("faults", faults), ("pace", pace)):
            if value is not None:
                raise BadInputError(name, value, f"none with method {method}")


def _run_formations(
    scenario: Scenario,
    out: Path | None,
    transport: str | None,
    faults: FaultSource,
    local: partial[LocalRun],
    *,
    show: bool,
) -> Outcome:
    check_moves(scenario)
    demand = demand_of(scenario)
    vehicles = {*demand.vehicles}
    specification = load_faults(faults, coordinator_names(scenario), vehicles, name="faults")
    # Coordinators in other processes load the solver there; errors are reported here.
    prepare(scenario.formation.solver, "formation.solver", keep=transport == SIMULATED)
    if transport != SIMULATED:
        with new_folder(out, scenario, FORMATION) as folder:
            return local(scenario, folder, specification, demand=demand).run()
    with (
        _only_run(),
        new_folder(out, scenario, FORMATION) as folder,
        tuned_garbage_collector(),
    ):
        run = SimulatedRun(scenario, folder, specification, show_progress=show, demand=demand)
        return run.run()


@contextmanager
def _only_run() -> Iterator[None]:
    """Exclude other runs in this process.

    Raises:
        CommandFailedError: there is one.
    """
    if not _in_process.acquire(blocking=False):
        raise CommandFailedError("another run is under way in this process")
    try:
        yield
    finally:
        _in_process.release()
