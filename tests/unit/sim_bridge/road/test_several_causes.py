"""Breakdowns, closed parts and vehicles of other systems in one lane, as many as there may be."""

from __future__ import annotations

from random import Random

import pytest
from attrs import evolve

from laneweave.protocol.road_layout import end_exit
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Demand, RoadEvent
from laneweave.sim_bridge.road.obstacles import Breakdown
from support import road_bugs
from support.bugs import catches
from support.closed_lanes import DROP, LonelyRoad, road_with
from support.variants import variants

ROAD = road_with(s3_m=850.0)
END_S = 1500.0
"""All vehicles have left long before."""


def drawn_event(random: Random, lane: int) -> RoadEvent:
    """Return an event of the road: a slow vehicle, a fast one or a closed part."""
    lane = lane if random.random() < 0.8 else random.randrange(3)
    length_m, kind = random.uniform(3.0, 12.0), random.random()
    first_m, last_m = (
        (85.0, 800.0) if kind < 0.35 else (0.0, 200.0) if kind < 0.75 else (150.0, 700.0)
    )
    from_m = random.uniform(first_m, last_m)
    if kind >= 0.75:
        length_m = random.uniform(5.0, 150.0)
    at_s = random.uniform(5.0, 60.0)
    event = RoadEvent(lane, from_m, from_m + length_m, at_s)
    if 0.35 <= kind < 0.75:
        speed_mps = random.choice([15.0, 17.0, 20.0, 25.0, 30.0, 40.0])
        return evolve(event, speed_mps=speed_mps, clear_s=random.uniform(0.0, 30.0))
    if kind < 0.35:
        event = evolve(event, speed_mps=random.choice([0.5, 2.0, 5.0, 10.0, 14.9]))
        return evolve(event, for_s=random.uniform(20.0, 80.0), clear_s=random.uniform(0.0, 30.0))
    return evolve(event, for_s=random.uniform(5.0, 60.0), clear_s=random.uniform(0.0, 30.0))


def drawn_breakdown(random: Random, lane: int) -> Breakdown:
    return Breakdown(
        random.uniform(20.0, 70.0),
        lane=lane if random.random() < 0.8 else random.randrange(3),
        at_m=random.uniform(60.0, 800.0),
        decel_mps2=random.uniform(1.0, 8.0),
        for_s=random.uniform(1.0, 60.0),
    )


def drawn_road(seed: int, scenario: Scenario = ROAD) -> LonelyRoad:
    random = Random(seed)
    lane = random.randrange(3)
    drawn_events = [drawn_event(random, lane) for _ in range(random.randrange(1, 4))]
    # Vehicles of other systems do not change lanes.
    sections = scenario.geometry.sections
    to_end = {one.lane for one in sections if one.exit == end_exit(one.lane)}
    events = tuple(one for one in drawn_events if not one.speed_mps or one.lane in to_end)
    breakdowns = [drawn_breakdown(random, lane) for _ in range(random.randrange(1, 4))]
    volume = random.choice([200.0, 600.0, 1000.0, 1500.0])
    demand = Demand(volume_veh_per_lane_h=volume, duration_s=60.0)
    road = evolve(scenario.road, events=events)
    drawn = evolve(scenario, demand=demand, seed=seed % 7, road=road)
    return LonelyRoad(drawn, tuple(breakdowns))


FOUND = (
    27,
    57,
    127,
    14,
    20,
    28,
    34,
    41,
    44,
    54,
    60,
    69,
    103,
    115,
    143,
    194,
    275,
    281,
    305,
    338,
    459,
    1249,
)
"""Seeds at which vehicles were in closed parts or waited for ever, before this was mended."""


@pytest.mark.parametrize(
    "seed",
    [
        *variants(list(FOUND), 3),
        *(pytest.param(seed, marks=pytest.mark.full) for seed in range(1000, 1300)),
    ],
)
def test_bodies_do_not_touch_none_is_in_a_closed_part_and_all_leave(seed: int) -> None:
    run_to_end(drawn_road(seed))


@pytest.mark.parametrize(
    "seed",
    [*variants(range(7), 1), *(pytest.param(n, marks=pytest.mark.full) for n in range(7, 300))],
)
def test_the_same_before_the_end_of_a_lane(seed: int) -> None:
    run_to_end(drawn_road(seed, DROP))


@pytest.mark.more
@catches(road_bugs.parts_are_closed_before_vehicles_that_start)
def test_a_planted_bug_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    road_bugs.parts_are_closed_before_vehicles_that_start.plant(monkeypatch)
    with pytest.raises(AssertionError):
        run_to_end(drawn_road(34))


def run_to_end(road: LonelyRoad) -> None:
    """Check each tick until all have left the road."""
    demand, passing = road.roadside.demand, road.roadside.obstacles.passing
    while road.vehicles or passing.on_road or not demand.exhausted(road.t_s):
        road.step()
        assert road.overlaps == []
        assert road.t_s < END_S, f"still on the road: {sorted(road.vehicles)}"
