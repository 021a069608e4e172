"""A run with a method in this process, from its scenario to its outcome."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from laneweave.launch.methods import FORMATION, LC2013, RULE
from laneweave.launch.run.outcome import Outcome
from laneweave.launch.run.reference_run import ReferenceRun
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.scenario.tables import Scenario


def _run_formation(scenario: Scenario, folder: Path) -> Outcome:
    return SimulatedRun(scenario, folder, FORMATION, show_progress=False).run()


def _run_rule(scenario: Scenario, folder: Path) -> Outcome:
    return ReferenceRun(scenario, folder, RULE, show_progress=False).run()


def _run_lc2013(scenario: Scenario, folder: Path) -> Outcome:
    return ReferenceRun(scenario, folder, LC2013, show_progress=False).run()


_RUNS: Final[dict[str, Callable[[Scenario, Path], Outcome]]] = {
    FORMATION: _run_formation,
    RULE: _run_rule,
    LC2013: _run_lc2013,
}


def run_method(scenario: Scenario, method: str, folder: Path) -> Outcome:
    """Run a scenario with a method, repeatably: equal scenarios give equal trajectories.

    Args:
        scenario: what is run.
        method: as `laneweave run --method` names it.
        folder: where the run's files go.
    """
    return _RUNS[method](scenario, folder)
