"""Vehicles of the rule-based method, put where a test wants them and moved without SUMO."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

from attrs import define, evolve, field

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.road_layout import END_OF_ROAD, Exits
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.reference_road import Entrance, ReferenceVehicle
from laneweave.sim_bridge.baselines.rule_based import RuleTraffic
from laneweave.sim_bridge.baselines.rules import Rules
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Bodies
from laneweave.sim_bridge.road.demand import Arrival
from support.bridge_bench import PlainWorld, arrival

PAPER = Scenario()


def rule_scenario(**rule: Any) -> Scenario:  # noqa: ANN401 (fields)
    return parse_scenario({"rule": rule})


def vehicle(
    name: str,
    s_m: float,
    lane: int = 0,
    preferred_lane: int | None = None,
    speed_mps: float = 15.0,
    destination: str = END_OF_ROAD,
) -> ReferenceVehicle:
    wanted = lane if preferred_lane is None else preferred_lane
    return ReferenceVehicle(
        arrival=evolve(arrival(name, 0.0, lane, wanted), destination=destination),
        entered_s=0.0,
        s_m=s_m,
        speed_mps=speed_mps,
        y_m=(lane + 0.5) * PAPER.road.lane_width_m,
        lane=lane,
    )


@define
class RuleRoad:
    """A road of the rule-based method in which bodies are shown where they are."""

    scenario: Scenario
    vehicles: Iterable[ReferenceVehicle] = ()
    entrance: Entrance = field(init=False)
    traffic: RuleTraffic = field(init=False)
    left: list[ReferenceVehicle] = field(factory=list)
    tick: int = 0
    _exits: Exits = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Put the vehicles on the road."""
        world = PlainWorld()
        self._exits = Exits(self.scenario.geometry.sections, self.scenario.road.length_m)
        self.entrance = Entrance(self.scenario)
        self.traffic = RuleTraffic(self.scenario, world, Rules(self.scenario))
        for one in self.vehicles:
            self.traffic._vehicles[one.name] = one
            self.traffic._lanes.enter(one, one.lane)
            world.add(one.name, one.state)

    @property
    def t_s(self) -> float:
        """Road time."""
        return self.tick * self.scenario.runtime.tick_s

    def step(self) -> Sequence[ReferenceVehicle]:
        """Advance by one tick; return the vehicles that entered."""
        self.tick += 1
        entered = self.traffic.step(self.t_s, self.entrance)
        limits = self.scenario.vehicle
        for one in list(self.traffic.vehicles):
            assert 0.0 <= one.speed_mps <= self.scenario.formation.speed_mps
            assert limits.min_accel_mps2 - 1e-9 <= one.accel_mps2 <= limits.max_accel_mps2 + 1e-9
            if self._exits.left_by(int(one.y_m // PAPER.road.lane_width_m), one.s_m) is not None:
                self.traffic.remove(one)
                self.left.append(one)
        poses = self.traffic.poses()
        assert Bodies(poses, limits.length_m, limits.width_m).overlapping_pairs() == []
        return entered

    def serve(self, arrivals: Sequence[Arrival], until_s: float) -> None:
        """Advance until all of a demand have left, up to a road time at most."""
        coming = deque(arrivals)
        while (coming or len(self.entrance) or self.traffic.vehicles) and self.t_s < until_s:
            while coming and coming[0].t_s <= self.t_s + self.scenario.runtime.tick_s:
                self.entrance.queue(coming.popleft())
            self.step()

    def run(self, seconds: float) -> None:
        """Advance until all vehicles have left, for at most this time."""
        end_s = self.t_s + seconds
        while self.traffic.vehicles and self.t_s < end_s:
            self.step()
