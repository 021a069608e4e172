"""Which cells vehicles from a ramp get."""

from __future__ import annotations

from attrs import evolve

from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.corridors.take_over import Approaching
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission, EntryMeter
from support.outside import Outside


def meter_of(scenario: Scenario, taken: frozenset[Cell] = frozenset()) -> EntryMeter:
    return EntryMeter(
        scenario.lattice,
        0.5,
        entry_m=scenario.geometry.entry_m,
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
    assert same.cell[0] == column


def test_a_vehicle_that_would_be_too_early_is_slowed_down_on_its_way(scenario: Scenario) -> None:
    at_m = scenario.entrance[0].at_m
    ahead = on_ramp("a", at_m - 150.0, 20.0)
    close = evolve(on_ramp("b", at_m - 158.0, 20.0), s_m=at_m - 158.0)
    admissions, outside = admit(scenario, ahead, close)
    assert admissions == []
    slowed = outside.advice["b"]
    assert slowed is not None
    assert 3.0 <= slowed < 20.0
