"""Bodies with the sizes of their types."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.bodies.overlaps_and_gaps import NO_SIZES, Bodies, Pose, Size
from laneweave.sim_bridge.road.demand import Arrival


def bodies_of(
    poses: Mapping[str, Pose],
    arrivals: Iterable[Arrival],
    scenario: Scenario,
    others: Mapping[str, Size] = NO_SIZES,
) -> Bodies:
    """Return the bodies of vehicles, each with the size of its type.

    `others`: sizes of vehicles of other systems.
    """
    types = scenario.types
    sizes = {
        one.vehicle: types[one.vehicle_type].limits.size_m
        for one in arrivals
        if one.vehicle_type != CAR
    } | {**others}
    return Bodies(poses, *scenario.vehicle.size_m, sizes)
