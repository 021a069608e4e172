"""The world of a corridor as take-over sees it, without SUMO."""

from __future__ import annotations

from attrs import define, field

from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody
from laneweave.sim_bridge.corridors.take_over import Approaching, TakeOver
from laneweave.sim_bridge.road.demand import Arrival


@define
class Outside:
    """Vehicles on their way to the entrances, bodies behind the exits, and the advice given."""

    coming: list[Approaching] = field(factory=list)
    bodies: list[OtherBody] = field(factory=list)
    advice: dict[str, float | None] = field(factory=dict)
    keeping_lane: set[str] = field(factory=set)
    exhausted: bool = False
    start_lanes: tuple[int, ...] = ()
    departing: tuple[Arrival, ...] = ()
    outside: tuple[Arrival, ...] = ()

    def take_over(self, scenario: Scenario) -> TakeOver:
        """Return the traffic from outside of a road."""
        return TakeOver(scenario, self)

    def approaching(self, lane: int) -> list[Approaching]:
        return [one for one in self.coming if one.arrival.lane == lane]

    def others(self) -> list[OtherBody]:
        return self.bodies

    def advise(self, vehicle: str, speed_mps: float | None) -> None:
        self.advice[vehicle] = speed_mps

    def keep_lane(self, vehicle: str) -> None:
        self.keeping_lane.add(vehicle)
