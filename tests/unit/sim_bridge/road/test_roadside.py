"""Announcements, entries, counts and censuses of the roadside."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
from attrs import define, field

from laneweave.protocol.config.scenario_files import load_scenario, parse_scenario
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD
from laneweave.protocol.runtime.node import Send
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.structuring import structure
from laneweave.protocol.wire.messages import Census, ClosedFormation, Name, RoadClock
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.corridors.exit_room import HELD_ANNOUNCED
from laneweave.sim_bridge.corridors.take_over import STANDING_S
from laneweave.sim_bridge.road.demand import Arrival, arrivals
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.outside import Outside
from support.paper import closing_time_s, paper
from support.road_vehicles import vehicle_in
from support.variants import variants


def crowded(operation: str = "paper", **runtime: Any) -> Scenario:  # noqa: ANN401 (fields)
    """More than twice what can enter: the queue grows as long as there is demand."""
    return parse_scenario(
        {
            "demand": {"volume_veh_per_lane_h": 3600, "duration_s": 120, "min_headway_s": 0.5},
            "formation": {"operation": operation},
            "runtime": runtime,
        }
    )


AWKWARD = {
    "demand": {"volume_veh_per_lane_h": 2000, "min_headway_s": 1.8, "duration_s": 400},
    "formation": {"gap_m": 13.5, "cycle_s": 3.9, "move_s": 3.6},
    "runtime": {"tick_s": 0.3},
    "braking": {"reaction_s": 0.3},
}
"""Vehicles arrive in step, every 1.8 s; ticks and passing times meet, but for rounding."""
LONG_TICKS = {
    "demand": {"volume_veh_per_lane_h": 3600, "min_headway_s": 0.1, "duration_s": 120},
    "formation": {"gap_m": 5.5, "speed_mps": 50, "move_s": 4.0},
    "vehicle": {"max_speed_mps": 60, "length_m": 4.0},
    "tracking": {"min_gap_m": 1.0},
    "road": {"s3_m": 1000},
    "runtime": {"tick_s": 1.0},
}
"""More than one vehicle enters on a lane in a tick; nobody could drive so close, so nothing checks
how these fields fit together."""


class Watch:
    """Lets a roadside run dry, and checks at every tick what holds at every tick."""

    def __init__(self, scenario: Scenario) -> None:
        """Prepare a roadside."""
        self.roadside = Roadside(scenario, arrivals(scenario))
        self.demanded: set[str] = set()
        self.announced: set[str] = set()
        self.entered: list[str] = []
        self.most_announced = 0
        self._scenario = scenario

    def run(self) -> None:
        tick = 0
        while not self.roadside.demand.exhausted(tick * self._scenario.runtime.tick_s):
            self.tick(tick)
            tick += 1
            assert tick < 1_000_000
        counts = self.roadside.publisher.clock(tick, 0.0, on_road=0)
        assert counts.demanded == counts.entered == len(self.entered) == len(set(self.entered))

    def tick(self, tick: int) -> None:
        roadside, t_s = self.roadside, tick * self._scenario.runtime.tick_s
        self.demanded |= {arrival.vehicle for arrival in roadside.demand.newly_demanded(t_s)}
        for admission in roadside.admit(t_s):
            vehicle = admission.arrival.vehicle
            assert vehicle in self.demanded
            assert vehicle in self.announced
            self.entered.append(vehicle)
        counts = roadside.publisher.clock(tick, t_s, on_road=0)
        assert (counts.demanded, counts.entered) == (len(self.demanded), len(self.entered))
        roadside.publisher.update_announcements(t_s)
        announced = roadside.publisher.census(t_s, ()).announced
        assert [(a.arrival_s, a.vehicle) for a in announced] == sorted(
            (a.arrival_s, a.vehicle) for a in announced
        )
        names = {announcement.vehicle for announcement in announced}
        assert not names & set(self.entered)
        # Once announced, announced until entered: agents rely on it.
        assert self.announced - set(self.entered) <= names
        self.announced |= names
        self.most_announced = max(self.most_announced, len(names))


@pytest.mark.parametrize("announce_s", [0.0, 0.05, 6.0, 30.0])
@pytest.mark.parametrize(("operation", "columns"), [("paper", 2), ("rolling", 1)])
def test_every_vehicle_is_announced_before_entering_and_never_too_many_at_once(
    announce_s: float, operation: str, columns: int
) -> None:
    scenario = crowded(operation, announce_s=announce_s)
    watch = Watch(scenario)
    watch.run()
    assert len(watch.entered) > 300
    # On each lane one vehicle can enter in so many columns' time.
    lattice = scenario.lattice
    per_lane = math.ceil((announce_s + 0.1) * lattice.speed_mps / (columns * lattice.pitch_m)) + 1
    assert watch.most_announced == per_lane * lattice.lanes


@pytest.mark.parametrize(
    "data",
    [
        *(AWKWARD | {"seed": seed} for seed in range(3)),
        *(LONG_TICKS | {"runtime": {"tick_s": 1.0, "announce_s": at_s}} for at_s in (0.0, 2.0)),
    ],
)
def test_demand_is_counted_before_the_entry_however_awkward_or_long_the_ticks(
    data: dict[str, Any],
) -> None:
    watch = Watch(structure(data, Scenario))
    watch.run()
    assert len(watch.entered) > 300


def test_announcements_come_in_time_and_say_what_is_known() -> None:
    scenario = parse_scenario({"demand": {"volume_veh_per_lane_h": 200, "duration_s": 100}})
    stream = arrivals(scenario)
    roadside = Roadside(scenario, stream)
    seen: dict[str, float] = {}
    for tick in range(1200):
        t_s = 0.1 * tick
        roadside.demand.newly_demanded(t_s)
        roadside.admit(t_s)
        roadside.publisher.update_announcements(t_s)
        assert not roadside.publisher.update_announcements(t_s)
        for announcement in roadside.publisher.census(t_s, ()).announced:
            seen.setdefault(announcement.vehicle, t_s)
            arrival = next(a for a in stream if a.vehicle == announcement.vehicle)
            assert announcement.lane == arrival.lane
            assert announcement.preferred_lane == arrival.preferred_lane
            assert announcement.arrival_s == arrival.t_s
    assert len(seen) == len(stream) > 5
    for arrival in stream:
        # The queues are short here: no vehicle waits for an announcement.
        assert arrival.t_s - seen[arrival.vehicle] > min(arrival.t_s, 5.9) - 0.2


def test_the_census_lists_the_road_as_it_was_entered() -> None:
    scenario = Scenario()
    roadside = Roadside(scenario, arrivals(scenario))
    admissions: list[Admission] = []
    tick = 0
    while not admissions:
        admissions = roadside.admit(0.1 * tick)
        tick += 1
    vehicles = [RoadVehicle.entering(each, 0.1 * tick, scenario) for each in admissions]
    for vehicle in vehicles:
        vehicle.controller.hold_cell = (9, 9)  # wherever it is by now
    entries = roadside.publisher.census(9.0, vehicles).on_road
    assert [(e.vehicle, e.cell, e.entered_s) for e in entries] == [
        (a.arrival.vehicle, a.cell, a.t_s) for a in admissions
    ]


def test_the_clock_has_the_counts() -> None:
    roadside = Roadside(Scenario(), ())
    roadside.on_left(vehicle_in((0, 1)), {}, 1.0)
    clock = roadside.publisher.clock(5, 0.5, 7, ended=True)
    assert clock == RoadClock(5, 0.5, demanded=0, entered=0, on_road=7, left=1, ended=True)


@pytest.mark.parametrize("ended", [False, True])
def test_all_news_name_the_bridge_that_they_come_from(*, ended: bool) -> None:
    news = list(Roadside(Scenario(), (), 17).publish(0, 0.0, (), ended=ended))
    messages = [effect.message for effect in news if isinstance(effect, Send)]
    assert [type(message) for message in messages] == [RoadClock, Census]
    assert [message.bridge for message in messages] == [17, 17]


def test_is_not_exhausted_before_the_last_arrival() -> None:
    scenario = parse_scenario({"demand": {"volume_veh_per_lane_h": 60, "duration_s": 60}})
    stream = arrivals(scenario)
    roadside, last_s = Roadside(scenario, stream), stream[-1].t_s
    assert not roadside.demand.exhausted(last_s + 1.0)  # none has been queued
    roadside.admit(last_s - 0.01)
    assert not roadside.demand.exhausted(last_s + 1.0)  # a vehicle waits
    roadside.admit(last_s + 60.0)
    assert not roadside.demand.exhausted(last_s - 0.01)
    assert roadside.demand.exhausted(last_s)


def test_a_census_reports_a_closed_block_at_once() -> None:
    """The leader need not wait for the next second to know a roster."""
    scenario = paper(load_scenario(None, seed=1, demand__duration_s=0.001))
    roadside = Roadside(scenario, arrivals(scenario))
    tick_s, reported = scenario.runtime.tick_s, {}
    for tick in range(100):
        roadside.close_formations(tick * tick_s)
        for effect in roadside.publish(tick, tick * tick_s, []):
            if isinstance(effect, Send) and isinstance(effect.message, Census):
                reported[tick] = effect.message.closed_to
    for block in range(2):
        first = min(tick for tick in reported if reported[tick] >= block)
        assert first == math.ceil(closing_time_s(block, scenario) / tick_s - 1e-6)
    assert len(reported) < 20


@define
class CensusWatch:
    """Lets vehicles in and out, and checks the formations of each census."""

    scenario: Scenario
    vehicles: dict[Name, RoadVehicle] = field(factory=dict)
    reported: dict[int, ClosedFormation] = field(factory=dict)
    """Closed formations in censuses, by number."""
    closed_to: int = -1
    left: int = 0

    def run(self, end_s: float) -> None:
        tick_s = self.scenario.runtime.tick_s
        roadside = Roadside(self.scenario, arrivals(self.scenario))
        for tick in range(round(end_s / tick_s)):
            self._tick(roadside, tick, tick * tick_s)

    def _tick(self, roadside: Roadside, tick: int, t_s: float) -> None:
        for admission in roadside.admit(t_s):
            vehicle = RoadVehicle.entering(admission, t_s, self.scenario)
            self.vehicles[vehicle.name] = vehicle
            assert vehicle.block > self.closed_to, "a vehicle entered a closed block"
            assert vehicle.formation is None
            assert vehicle.controller.record.joined == (vehicle.block,)
        closed = roadside.close_formations(t_s)
        for formation in closed:
            for vehicle in self.vehicles.values():
                if vehicle.block in formation.blocks:
                    vehicle.join(formation)
        lasts_s = self.scenario.road.length_m / self.scenario.formation.speed_mps
        for name, vehicle in list(self.vehicles.items()):
            if t_s > vehicle.admission.t_s + lasts_s:
                del self.vehicles[name]
                self.left += 1
        censuses = [
            effect.message
            for effect in roadside.publish(tick, t_s, self.vehicles.values())
            if isinstance(effect, Send) and isinstance(effect.message, Census)
        ]
        assert censuses or not closed, "a formation has closed without a census"
        for census in censuses:
            self._check(census)

    def _check(self, census: Census) -> None:
        assert census.closed_to >= self.closed_to
        self.closed_to = census.closed_to
        for one, other in pairwise(census.formations):
            assert one.last_block < other.first_block
        for formation in census.formations:
            assert formation.closed_s <= census.t_s
            assert formation.last_block <= census.closed_to
            assert self.reported.setdefault(formation.first_block, formation) == formation
        present = set()
        for vehicle in self.vehicles.values():
            if vehicle.block > census.closed_to:
                assert vehicle.formation is None
                continue
            (mine,) = (one for one in census.formations if vehicle.block in one.blocks)
            assert vehicle.formation == mine.first_block
            assert vehicle.controller.record.joined == mine.blocks
            present.add(mine)
        assert set(census.formations) == present


@pytest.mark.slow
@pytest.mark.parametrize("volume", variants([2000.0, 30.0, 1000.0]))
def test_a_census_reports_owners_of_columns_and_closed_ones(volume: float) -> None:
    scenario = load_scenario(
        None, seed=3, demand__duration_s=200.0, demand__volume_veh_per_lane_h=volume
    )
    watch = CensusWatch(scenario)
    watch.run(300.0)
    assert watch.left > 0
    assert not watch.vehicles
    used = [block for formation in watch.reported.values() for block in formation.blocks]
    assert len(set(used)) == len(used), "a column has two formations"


def test_a_census_of_the_rolling_operation_has_no_formations() -> None:
    scenario = load_scenario(None, formation__operation="rolling")
    roadside = Roadside(scenario, arrivals(scenario))
    for tick in range(600):
        roadside.admit(0.1 * tick)
        assert roadside.close_formations(0.1 * tick) == []
    census = roadside.publisher.census(60.0, ())
    assert (census.formations, census.closed_to) == ((), -1)


# --- vehicles that are held back --------------------------------------------------------------

OFF_RAMP = {
    "road": {
        "lanes": 4,
        "s3_m": 850.0,
        "closures": [{"lane": 0, "to_m": 500.0}, {"lane": 0, "from_m": 800.0}],
    },
    "exit": [{"name": "off", "lanes": [0], "at_m": 800.0}],
    "demand": {"destinations": [{"exit": "off", "share": 0.2}]},
    "formation": {"operation": "rolling"},
}


QUEUE = OtherBody("queue", 0, 800.0, 801.0, 5.0, 0.0, 0.0)
"""It leaves no room behind the exit."""


def held_roadside(outside: Outside, exits: int) -> tuple[Roadside, Scenario]:
    scenario = parse_scenario(OFF_RAMP)
    stream = tuple(
        Arrival(f"v{n:04}", 1, ANY_LANE, 2.0 + 2.0 * n, "off" if n <= exits else END_OF_ROAD)
        for n in range(1, 9)
    )
    return Roadside(scenario, stream, outside_traffic=outside.take_over(scenario)), scenario


def admitted(roadside: Roadside, scenario: Scenario, from_s: float, to_s: float) -> list[Admission]:
    found: list[Admission] = []
    tick_s = scenario.runtime.tick_s
    for tick in range(round(from_s / tick_s), round(to_s / tick_s)):
        roadside.demand.newly_demanded(tick * tick_s)
        found += roadside.admit(tick * tick_s)
        roadside.publisher.update_announcements(tick * tick_s)
    return found


def test_a_vehicle_that_is_held_back_is_announced_and_enters_when_it_is_released() -> None:
    outside = Outside(bodies=[QUEUE])
    roadside, scenario = held_roadside(outside, exits=1)
    before = admitted(roadside, scenario, 0.0, 60.0)
    # It does not keep those behind it back.
    assert [one.arrival.vehicle for one in before] == [f"v{n:04}" for n in range(2, 9)]
    assert [one.vehicle for one in roadside.publisher.census(60.0, ()).announced] == ["v0001"]
    assert not roadside.demand.exhausted(60.0)
    outside.bodies.clear()
    (late,) = admitted(roadside, scenario, 60.0, 65.0)
    assert late.arrival.vehicle == "v0001"
    # It does not enter in the past, where its body would be on the road already.
    assert late.t_s >= 60.0 - scenario.runtime.tick_s


def test_few_vehicles_of_those_that_are_held_back_are_announced() -> None:
    roadside, scenario = held_roadside(Outside(bodies=[QUEUE]), exits=7)
    assert len(admitted(roadside, scenario, 0.0, 60.0)) == 1
    assert len(roadside.publisher.census(60.0, ()).announced) == HELD_ANNOUNCED


def test_a_road_on_which_all_stand_is_over_when_no_more_vehicles_come() -> None:
    outside = Outside(bodies=[QUEUE])
    roadside, scenario = held_roadside(outside, exits=7)
    (one,) = admitted(roadside, scenario, 0.0, 60.0)
    vehicle = RoadVehicle.entering(one, 20.0, scenario, 0)
    vehicles = {vehicle.name: vehicle}
    assert not roadside.is_over(60.0, vehicles)
    standing = (100.0, 0.0, 0.0, 1.75, 0.0, 0.0)
    vehicle.controller.plant = Plant(standing, scenario.vehicle, 0.1)
    outside.exhausted = True
    assert not roadside.is_over(60.0 + 0.5 * STANDING_S, vehicles)
    assert roadside.is_over(60.0 + STANDING_S, vehicles)
    outside.exhausted = False
    assert not roadside.is_over(60.0 + STANDING_S, vehicles)
