"""The coordinator process over Zenoh."""

from __future__ import annotations

from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.planning import warm_up
from laneweave.protocol.access import access_of
from laneweave.protocol.faulty_core import Wrap, bare
from laneweave.protocol.incarnations import Incarnations
from laneweave.protocol.messages import Name
from laneweave.protocol.scenario import Scenario
from laneweave.protocol.zenoh_transport import run_core


def run_coordinator(scenario: Scenario, name: str, wrap: Wrap = bare) -> None:
    """Run a coordinator candidate until SIGINT or SIGTERM; `wrap` may put faults before it.

    It stands for election when it is able to plan at once, so the planner is loaded before.

    Raises:
        BadInputError: nobody answers at the scenario's endpoint.
    """
    warm_up()
    core = CoordinatorCore(Name(name), Incarnations()(), scenario)
    run_core(wrap(core), access_of(scenario, f"coordinator.{name}"))
