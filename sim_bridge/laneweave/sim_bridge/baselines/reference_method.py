"""A reference method: what a plug-in of the group `laneweave.methods` provides."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from pathlib import Path

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.reference_road import Traffic


def check_no_lane_rules(scenario: Scenario, method: str) -> None:
    """Check that a scenario has no rules that the built-in methods do not know.

    Raises:
        BadInputError: it has restrictions or solid lines.
    """
    road = scenario.road
    for name, rules in (("restrictions", road.restrictions), ("solid_lines", road.solid_lines)):
        if rules:
            lanes = [one.lane for one in rules]
            raise BadInputError(f"road.{name}", lanes, f"none with --method {method}")


class ReferenceMethod(ABC):
    """A method that drives the vehicles without formations, agents or messages.

    An entry point of the group `laneweave.methods` names a subclass without arguments, or an
    instance. laneweave provides demand and entrances, measures gaps and overlaps, and records.
    """

    def check(self, scenario: Scenario) -> None:  # noqa: B027 (by default, all are supported)
        """Check that the method supports a scenario, before anything is started.

        Raises:
            BadInputError: it does not support the value of a field.
        """

    @abstractmethod
    def open(self, scenario: Scenario, folder: Path) -> AbstractContextManager[Traffic]:
        """Return a context manager that yields the traffic of one run, on an empty road.

        Args:
            scenario: road, demand, vehicle limits and `runtime.tick_s`.
            folder: an empty folder for temporary files, such as those of `SumoWorld`.
        """
