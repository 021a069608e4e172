"""Which cells vehicles from a ramp get."""

from __future__ import annotations

from attrs import evolve

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody
from laneweave.sim_bridge.corridors.take_over import VEHICLES_PER_CHANGE, Approaching
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission, EntryMeter
from support.outside import Outside


def meter_of(scenario: Scenario, taken: frozenset[Cell] = frozenset()) -> EntryMeter:
    return EntryMeter(
        scenario.lattice,
        0.5,
        entry_points=scenario.geometry.entry_points,
        column_bound={"car", "truck"},
        is_free=lambda cell: cell not in taken,
    )


def admit(
    scenario: Scenario,
    *coming: Approaching,
    taken: frozenset[Cell] = frozenset(),
    occupied: frozenset[Cell] = frozenset(),
    t_s: float = 50.0,
) -> tuple[list[Admission], Outside]:
    outside = Outside([*coming])
    ramps = outside.take_over(scenario)
    ramps.demanded(t_s)
    return ramps.admit(t_s, meter_of(scenario, taken), occupied), outside


def on_ramp(name: str, s_m: float, speed_mps: float, kind: str = "car") -> Approaching:
    return Approaching(
        Arrival(name, 0, ANY_LANE, 0.0, vehicle_type=kind), s_m, speed_mps, ((9e9, 22.0),)
    )


def test_a_slow_vehicle_gets_a_cell_to_which_it_can_fall_back(scenario: Scenario) -> None:
    at_m = scenario.entrance[0].at_m
    (fast,), _ = admit(scenario, on_ramp("a", at_m + 1.0, 22.0))
    (slow,), _ = admit(scenario, on_ramp("b", at_m + 1.0, 15.0))
    assert slow.cell[0] <= fast.cell[0]
    for admission, speed_mps in ((fast, 22.0), (slow, 15.0)):
        assert admission.start is not None
        assert admission.start.speed_mps == speed_mps
        assert admission.offset_m > 0.0
    assert slow.start is not None
    assert fast.start is not None
    assert slow.start.settle_s > fast.start.settle_s


def test_one_behind_another_gets_a_column_behind_it(scenario: Scenario) -> None:
    at_m = scenario.entrance[0].at_m
    coming = on_ramp("a", at_m + 30.0, 20.0), on_ramp("b", at_m + 1.0, 20.0)
    first, second = admit(scenario, *coming)[0]
    assert second.cell[0] < first.cell[0]


def test_a_vehicle_never_gets_a_cell_that_it_cannot_have(scenario: Scenario) -> None:
    """Not even where none of the columns that it would reach in time is free."""
    at_m = scenario.entrance[0].at_m
    (alone,), _ = admit(scenario, on_ramp("a", at_m + 1.0, 20.0))
    taken = frozenset((alone.cell[0] + 3 - number, 0) for number in range(25))
    coming = on_ramp("a", at_m + 28.0, 20.0), on_ramp("b", at_m + 1.0, 20.0)
    first, second = admit(scenario, *coming, taken=taken)[0]
    assert first.cell not in taken
    assert second.cell not in taken
    assert second.cell[0] < first.cell[0]


def test_a_vehicle_rather_enters_where_nobody_has_to_make_room(scenario: Scenario) -> None:
    at_m = scenario.entrance[0].at_m
    (alone,), _ = admit(scenario, on_ramp("a", at_m + 1.0, 20.0))
    column = alone.cell[0]
    beside = frozenset({(column, 1)})
    (moved,), _ = admit(scenario, on_ramp("a", at_m + 1.0, 20.0), occupied=beside)
    assert moved.cell[0] == column - 1
    everywhere = frozenset((column - number, 1) for number in range(20))
    (same,), _ = admit(scenario, on_ramp("a", at_m + 1.0, 20.0), occupied=everywhere)
    assert column - same.cell[0] <= 1  # those beside it may need the time of a column


def test_no_vehicle_enters_while_sumo_may_let_a_vehicle_depart_just_before_the_start(
    scenario: Scenario,
) -> None:
    upstream = Arrival("u", 1, ANY_LANE, 100.0)
    ramp = Arrival("r", 0, ANY_LANE, 50.0)
    outside = Outside(start_lanes=(1, 2), departing=(ramp, upstream))
    take_over = outside.take_over(scenario)

    def full(t_s: float) -> set[int]:
        take_over.demanded(t_s)
        take_over.announced(t_s)
        return take_over.full_lanes(t_s)

    times_s = (50.0, 99.0, 99.8, 104.0)
    assert [full(t_s) for t_s in times_s] == [set(), set(), {1, 2}, {1, 2}]
    assert full(105.5) == set()  # it appears only when SUMO has room for it


def test_a_vehicle_that_would_be_too_early_is_slowed_down_on_its_way(scenario: Scenario) -> None:
    at_m = scenario.entrance[0].at_m
    ahead = on_ramp("a", at_m - 150.0, 20.0)
    close = evolve(on_ramp("b", at_m - 158.0, 20.0), s_m=at_m - 158.0)
    admissions, outside = admit(scenario, ahead, close)
    assert admissions == []
    slowed = outside.advice["b"]
    assert slowed is not None
    assert 3.0 <= slowed < 20.0


def test_of_several_right_lanes_a_vehicle_prefers_the_one_with_the_fewest_vehicles() -> None:
    approach = parse_scenario(
        {
            "road": {"lanes": 4, "s1_m": 50.0, "s2_m": 0.0, "s3_m": 350.0},
            "formation": {"operation": "rolling", "change_columns": False, "gap_m": 20.0},
        }
    )

    def preferred(in_lane_1: int, in_lane_2: int, on_road: int = 0, lane: int = 0) -> int:
        counts = {1: in_lane_1, 2: in_lane_2}
        bodies = [
            OtherBody(f"{lane}.{number}", lane, 400.0, 390.0 - 7.5 * number, 5.0, 0.0, 0.0)
            for lane, count in counts.items()
            for number in range(count)
        ]
        outside = Outside(bodies=bodies, start_lanes=(0, 1, 2, 3))
        arrival = Arrival("a", lane, 1, 0.0, right_lanes=(1, 2))
        outside.coming.append(Approaching(arrival, 0.5, 12.0, ((9e9, 14.0),)))
        take_over = outside.take_over(approach)
        take_over.demanded(50.0)
        take_over.release((), [Arrival(f"r{n}", 3, 1, 0.0) for n in range(on_road)])
        (admission,) = take_over.admit(50.0, EntryMeter(approach.lattice, 0.5), ())
        return admission.arrival.preferred_lane

    assert preferred(0, 0) == preferred(4, 4) == preferred(5, 3) == 1
    assert preferred(6, 3) == preferred(5, 3, on_road=1) == 2
    # A lane change is worth it only if it saves the time of some vehicles.
    assert preferred(VEHICLES_PER_CHANGE, 0) == 1
    assert preferred(VEHICLES_PER_CHANGE + 1, 0) == 2
    # Nor does it prefer a lane that it cannot reach before the queue there.
    assert preferred(30, 20, lane=1) == 2
    assert preferred(40, 30, lane=1) == 1
