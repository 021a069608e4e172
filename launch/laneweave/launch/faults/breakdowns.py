"""Breakdowns of a fault specification, for the bridge."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator

from laneweave.launch.faults.fault_file import BreakdownFault, FaultSpec
from laneweave.protocol.errors import BadInputError, Described
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.road.obstacles import Breakdown


def breakdowns_of(faults: FaultSpec, scenario: Scenario) -> list[Breakdown]:
    """Return the vehicles that are to break down in a run; those that are not named are drawn.

    Raises:
        BadInputError: the road is a corridor, whose vehicles SUMO drives, too.
    """
    if faults.breakdown and scenario.sumo.config:
        allowed = "nothing in a corridor of a SUMO simulation"
        raise BadInputError("breakdown", Described("a table"), allowed)
    seed = faults.seed_of_run(scenario.seed)
    return [one for name, fault in faults.breakdowns() for one in _drawn(name, fault, seed)]


def _drawn(name: str, fault: BreakdownFault, seed: int) -> Iterator[Breakdown]:
    draw = random.Random(f"{seed}/{name}")  # noqa: S311 (simulation, no secrets)
    for _ in range(fault.count):
        yield Breakdown(
            fault.at_s,
            None if fault.vehicle is None else Name(fault.vehicle),
            fault.lane,
            fault.at_m,
            draw.random(),
            fault.decel_mps2,
            math.inf if fault.for_s is None else fault.for_s,
        )
