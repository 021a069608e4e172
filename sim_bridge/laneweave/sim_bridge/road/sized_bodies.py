"""Bodies with the sizes of their types."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Bodies, Pose
from laneweave.sim_bridge.road.demand import Arrival


def bodies_of(poses: Mapping[str, Pose], arrivals: Iterable[Arrival], scenario: Scenario) -> Bodies:
    """Return the bodies of vehicles, each with the size of its type."""
    types = scenario.types
    sizes = {
        one.vehicle: types[one.vehicle_type].limits.size_m
        for one in arrivals
        if one.vehicle_type != CAR
    }
    return Bodies(poses, *scenario.vehicle.size_m, sizes)
