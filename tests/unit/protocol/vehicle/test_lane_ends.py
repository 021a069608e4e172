"""Where lanes end, where vehicles stop before that, and how much room they need to drive on."""

from __future__ import annotations

import math
from random import Random

import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from laneweave.agents.driving.reference import Reference
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import (
    ANY_LANE,
    ClearedPart,
    LaneSection,
    TemporaryParts,
    open_sections,
    sections_for,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Closure, Exit
from laneweave.protocol.vehicle.lane_end import LaneEnd
from laneweave.protocol.vehicle.lane_ends import (
    LaneEnds,
    dead_ends,
    early_start_m,
    lanes_beside,
    sections_to_lines,
)
from laneweave.protocol.vehicle.motion import cell_state
from laneweave.protocol.vehicle.re_entry import re_entry
from laneweave.protocol.wire.messages import CurrentMotion, Neighbour
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel, MotionController
from support.closed_lanes import BLOCKED, DROP
from support.convoy import ROLLING
from support.examples import examples
from support.road_vehicles import controller_in
from support.states import command

INF = math.inf
KEEPING = evolve(BLOCKED, formation=evolve(BLOCKED.formation, change_columns=False))
"""Vehicles keep their columns, and may begin moves a little before a lane opens."""


def with_closures(*closures: Closure) -> Scenario:
    return evolve(DROP, road=evolve(DROP.road, closures=closures))


# --- sections ---------------------------------------------------------------------------------


def test_a_road_without_closures_has_no_dead_ends() -> None:
    assert dead_ends(ROLLING) == ()
    assert not LaneEnds(ROLLING)
    assert sections_to_lines(ROLLING) == ROLLING.geometry.sections
    assert open_sections(2, 500.0) == (
        LaneSection(0, -INF, 500.0, "lane-0"),
        LaneSection(1, -INF, 500.0, "lane-1"),
    )


def test_closures_divide_lanes_into_sections_in_whichever_order_they_are_given() -> None:
    closed = [(0, 600.0, 700.0), (1, 800.0, INF), (0, 300.0, 350.0)]
    assert open_sections(2, 1000.0, closed) == (
        LaneSection(0, -INF, 300.0),
        LaneSection(0, 350.0, 600.0),
        LaneSection(0, 700.0, 1000.0, "lane-0"),
        LaneSection(1, -INF, 800.0),
    )


def test_sections_by_which_a_vehicle_may_leave() -> None:
    sections = open_sections(3, 1000.0, [(0, 600.0, 700.0), (1, 800.0, INF)])
    assert [sections_for(sections, lane) for lane in (0, 1, 2)] == [{1}, set(), {3}]
    assert sections_for(sections, ANY_LANE) == {1, 3}


def test_a_stop_line_lies_before_each_dead_end() -> None:
    room_m = re_entry(DROP).room_m
    assert dead_ends(DROP) == (LaneEnd(0, -INF, 800.0 - room_m, 800.0 - room_m, 800.0, INF),)
    assert dead_ends(BLOCKED) == (LaneEnd(1, -INF, 600.0 - room_m, 600.0 - room_m, 600.0, 700.0),)
    to_lines = sections_to_lines(BLOCKED)
    assert [section.to_m for section in to_lines] == [1000.0, 600.0 - room_m, 1000.0, 1000.0]
    assert [section.from_m for section in to_lines] == [-INF, -INF, 700.0, -INF]


@pytest.mark.parametrize(
    ("lane", "s_m", "end_m"),
    [
        (1, -50.0, 600.0), (1, 550.0, 600.0), (1, 599.0, 600.0),
        (1, 650.0, 600.0),  # it should not be there
        (1, 700.0, None), (1, 900.0, None), (0, 550.0, None), (-1, 550.0, None), (3, 550.0, None),
    ],
)  # fmt: skip
def test_the_dead_end_ahead_is_that_of_the_section(
    lane: int, s_m: float, end_m: float | None
) -> None:
    end = LaneEnds(BLOCKED).ahead(lane, s_m)
    assert (end.end_m if end is not None else None) == end_m


@pytest.mark.parametrize("speed_mps", [0.0, 5.0, 15.0, 25.0])
@pytest.mark.parametrize("seed", range(10))
def test_a_lane_change_enters_a_cleared_part_if_the_body_is_ever_beside_it(
    speed_mps: float, seed: int
) -> None:
    rng, lattice = Random(seed), ROLLING.lattice
    length_m = ROLLING.types.longest_body_m
    for _ in range(50):
        from_m = rng.uniform(0.0, 500.0)
        part = ClearedPart(1, from_m, from_m + rng.uniform(1.0, 200.0), speed_mps, 10.0)
        ends = LaneEnds(ROLLING, TemporaryParts(cleared=(part,)))
        assert ends
        column, t_s, takes_s = rng.randrange(-10, 30), rng.uniform(5.0, 20.0), rng.uniform(1.0, 6.0)
        origin = column, rng.choice([0, 2])
        target = column + rng.choice([-1, 0, 1]), 1
        columns = min(origin[0], target[0]), max(origin[0], target[0])
        beside = False
        for step in range(101):
            at_s = t_s + takes_s * step / 100.0
            first_m, last_m = part.at(at_s)
            rear_m = lattice.cell_s_m(columns[0], at_s) - length_m
            beside |= rear_m < last_m and lattice.cell_s_m(columns[1], at_s) > first_m
        assert ends.enters_cleared(origin, target, t_s, takes_s) is beside
        assert not beside or ends.too_late(origin, target, t_s, takes_s)
        # Out of it, or within the lane, they may move.
        assert not ends.enters_cleared(target, origin, t_s, takes_s)
        assert not ends.enters_cleared((column, 1), (column + 1, 1), t_s, takes_s)


def test_cells_pass_the_line_with_the_lattice() -> None:
    ends, (end,) = LaneEnds(BLOCKED), dead_ends(BLOCKED)
    lattice = BLOCKED.lattice
    passing_s = lattice.passing_time_s(-10, end.line_m)
    assert not ends.has_passed((-10, 1), passing_s - 0.01)
    assert ends.has_passed((-10, 1), passing_s + 0.01)
    assert not ends.has_passed((-10, 0), passing_s + 0.01)
    opens_s = lattice.passing_time_s(-10, 700.0)
    assert ends.has_passed((-10, 1), opens_s - 0.01)
    assert ends.has_passed((-10, 1), opens_s + 0.01, end.line_m)  # it was before the closed part
    assert not ends.has_passed((-10, 1), opens_s + 0.01)


def test_a_cell_is_in_a_lane_that_opens_again_as_soon_as_moves_into_it_may_begin() -> None:
    ends, lattice = LaneEnds(KEEPING), KEEPING.lattice
    begins_m = 700.0 + KEEPING.types.longest_body_m - early_start_m(KEEPING)
    assert begins_m < 700.0
    begins_s = lattice.passing_time_s(-10, begins_m)
    assert ends.has_passed((-10, 1), begins_s - 0.01)
    assert not ends.has_passed((-10, 1), begins_s + 0.01)
    assert ends.may_begin((-10, 1), (-10, 0), begins_s + 0.01)


def test_the_exit_before_does_not_end_moves_that_begin_before_the_lane_opens_again() -> None:
    exits = (Exit("first", (0,), 400.0), Exit("second", (0,), 900.0))
    closed = (Closure(0, 400.0, 700.0), Closure(0, 900.0))
    road = evolve(KEEPING.road, closures=closed)
    scenario = evolve(KEEPING, road=road, exit=exits)
    ends, lattice = LaneEnds(scenario), scenario.lattice
    begins_m = 700.0 + scenario.types.longest_body_m - early_start_m(scenario)
    assert begins_m < 700.0
    begins_s = lattice.passing_time_s(-10, begins_m)
    assert ends.too_late((-10, 1), (-10, 0), begins_s - 0.01)
    assert not ends.too_late((-10, 1), (-10, 0), begins_s + 0.01)


@pytest.mark.parametrize(
    ("closures", "beside"),
    [
        ((Closure(0, 800.0),), (1,)),
        ((Closure(2, 800.0),), (1,)),
        ((Closure(1, 800.0),), (2, 0)),
        ((Closure(1, 800.0), Closure(2, 800.0)), (0,)),
        ((Closure(0, 800.0), Closure(1, 800.0)), ()),
        ((Closure(0, 800.0), Closure(1, 960.0)), (1,)),  # it ends later than the vehicle needs it
    ],
)
def test_vehicles_drive_out_into_a_lane_that_is_open(
    closures: tuple[Closure, ...], beside: tuple[int, ...]
) -> None:
    scenario = with_closures(*closures)
    lane = closures[0].lane
    (end,) = (end for end in dead_ends(scenario) if end.lane == lane)
    sections = sections_to_lines(scenario)
    assert lanes_beside(scenario, end.lane, end.line_m, sections) == beside


# --- re-entry ---------------------------------------------------------------------------------


@examples(40)
@given(
    st.floats(8.0, 32.0), st.floats(12.0, 35.0), st.floats(2.0, 8.0), st.floats(4.0, 10.0),
    st.floats(0.0, 0.4), st.sampled_from((2.8, 3.5, 4.5)),
)  # fmt: skip
def test_a_vehicle_that_stands_gets_out_before_the_end_and_into_its_cell(
    speed_mps: float, gap_m: float, accel_mps2: float, brake_mps2: float, lag_s: float,
    lane_m: float,
) -> None:  # fmt: skip
    """The real motion controller does what was computed, and need not brake for the end."""
    vehicle = evolve(
        DROP.vehicle,
        max_speed_mps=1.5 * speed_mps,
        max_accel_mps2=accel_mps2,
        min_accel_mps2=-brake_mps2,
        actuator_lag_s=lag_s,
    )
    scenario = evolve(
        DROP,
        vehicle=vehicle,
        braking=evolve(DROP.braking, lead_brake_mps2=brake_mps2),
        formation=evolve(DROP.formation, speed_mps=speed_mps, gap_m=gap_m),
        road=evolve(DROP.road, lane_width_m=lane_m, closures=(Closure(0, 900.0),)),
    )
    try:
        needed = re_entry(scenario)
    except ValueError:
        return  # the limits are too low for this speed
    (end,) = dead_ends(scenario)
    assert end.end_m - end.line_m == needed.room_m
    lattice, tick_s = scenario.lattice, scenario.runtime.tick_s
    # The front of the gap passes the vehicle, which stands at the line.
    column = -1000
    start_tick = math.ceil(lattice.passing_time_s(column, end.line_m) / tick_s)
    standing = (end.line_m, 0.0, 0.0, lattice.cell_y_m(0), 0.0, 0.0)
    controller = controller_in((0, 0), scenario, state=standing)
    controller.leave_lattice()
    goal: Cell = (column - needed.columns + 1, 1)
    controller.re_enter(goal, (), keeps_distance=False)
    half_m = 0.5 * vehicle.width_m
    for tick in range(start_tick, start_tick + 700):
        controller.step(tick)
        s, v, _, y, _, _ = controller.plant.state
        if y - half_m < lane_m:
            assert s < end.end_m
        t_s = (tick + 1) * tick_s
        assert controller.level is not FallbackLevel.EMERGENCY
        # The vehicles before and behind the gap.
        assert s < lattice.cell_s_m(column + 1, t_s)
        if y + half_m > lane_m:
            assert s - vehicle.length_m > lattice.cell_s_m(column - needed.columns, t_s)
        if controller.has_settled(t_s):
            assert s - end.line_m <= needed.distance_m + 0.5 * speed_mps
            assert v == pytest.approx(speed_mps, abs=2.0)
            return
    pytest.fail("it has not arrived")


def test_a_vehicle_that_is_too_weak_is_refused_in_one_line() -> None:
    weak = evolve(DROP.vehicle, max_accel_mps2=0.1)
    with pytest.raises(ValueError, match="cannot get into the lattice"):
        re_entry(evolve(DROP, vehicle=weak))


# --- vehicles that reach the line -------------------------------------------------------------


@examples(60)
@given(st.data())
def test_no_command_takes_a_vehicle_past_its_stop_line(data: st.DataObject) -> None:
    """Whatever its agent wants, and with measurement errors."""
    (end,) = dead_ends(DROP)
    lattice = DROP.lattice
    speed_mps = data.draw(st.floats(0.0, 25.0))
    behind_m = data.draw(st.floats(speed_mps**2 / 14.0 + speed_mps + 5.0, 120.0))
    state = (end.line_m - behind_m, speed_mps, 0.0, lattice.cell_y_m(0), 0.0, 0.0)
    controller = controller_in((0, 0), DROP, state=state, incarnation=7)
    jerks = st.floats(-15.0, 15.0)
    errors, wanted = (0.0, 0.0), 0.0
    for tick in range(200):
        s, v, a, y, v_y, a_y = controller.plant.state
        if tick % 10 == 0:
            errors = data.draw(st.tuples(*[st.floats(-0.15, 0.15)] * 2))
            wanted = data.draw(jerks)
        measured = (s + errors[0], max(v + 0.4 * errors[1], 0.0), a, y, v_y, a_y)
        controller.perceive(measured, controller.neighbours)
        controller._jerks, controller._jerks_tick = controller._jerks[:0], tick
        controller._jerks.extend((wanted, 0.0))
        controller.step(tick)
        assert controller.plant.state[0] <= end.line_m


def lines(controller: MotionController, tick: int) -> list[Neighbour]:
    """Return the stop lines that a controller sees at a tick."""
    return controller.stop_lines.lines(
        controller.measured,
        controller.hold_cell,
        tick * controller.tick_s,
        enters=not controller._must_stay_in_lane(tick),
    )


def test_the_line_counts_for_a_lane_that_the_vehicle_is_about_to_enter() -> None:
    (end,) = dead_ends(DROP)
    state = (end.line_m - 10.0, 15.0, 0.0, DROP.lattice.cell_y_m(1), 0.0, 0.0)
    controller = controller_in((0, 1), DROP, state=state)
    assert lines(controller, 493) == []
    controller.hold_cell = (0, 0)
    (line,) = lines(controller, 493)
    assert (line.lane, line.speed_mps) == (0, 0.0)
    assert line.gap_m == pytest.approx(10.0)


@pytest.mark.parametrize("error_m", [-0.3, 0.0, 0.3])
def test_no_line_counts_in_a_lane_that_opens_again_for_a_move_behind_its_end(
    error_m: float,
) -> None:
    """The move may begin before the lane opens, and the body may be measured behind its cell."""
    lattice, tick_s = KEEPING.lattice, KEEPING.runtime.tick_s
    begins_m = 700.0 + KEEPING.types.longest_body_m - early_start_m(KEEPING)
    begin_tick = math.ceil(lattice.passing_time_s(-10, begins_m) / tick_s)
    state = cell_state(lattice, (-10, 0), begin_tick * tick_s)
    controller = controller_in((-10, 0), KEEPING, state=state, incarnation=7)
    controller.store.assign_cell((-10, 1))
    ticks = KEEPING.timing.move_ticks(KEEPING.timing.cycles_s[0])
    reference = Reference.move(KEEPING, KEEPING.vehicle, (-10, 0), (-10, 1), begin_tick, ticks)
    window = reference.window(begin_tick)
    move = command(begin_tick, *window.jerks.tolist(), hold_cell=(-10, 1), incarnation=7)
    assert controller.accept_command(
        replace(move, motion=CurrentMotion((-10, 0), move.motion.end_tick))
    )
    for tick in range(begin_tick, begin_tick + len(window.jerks)):
        s, v, a, y, v_y, a_y = controller.plant.state
        controller.perceive((s + error_m, v, a, y, v_y, a_y), controller.neighbours)
        assert lines(controller, tick) == []
        controller.step(tick)
        assert controller.level is FallbackLevel.EXECUTE


def test_a_body_that_must_stay_in_its_lane_does_not_stop_at_the_line_of_another() -> None:
    """It had begun a move into a lane that ends, and fell behind: it drives on in its own."""
    lattice = DROP.lattice
    state = (500.0, 5.0, 0.0, lattice.cell_y_m(1), 0.0, 0.0)
    controller = controller_in((0, 1), DROP, state=state)
    controller.motion, controller.hold_cell = CurrentMotion((8, 1)), (8, 0)
    for tick in range(333, 700):
        controller.step(tick)
        assert controller.plant.state[3] - 0.5 * DROP.vehicle.width_m > lattice.lane_width_m
    assert controller.plant.state[0] > DROP.road.length_m


def test_a_vehicle_that_was_stopped_in_two_lanes_goes_on() -> None:
    """Its move out of the lane was interrupted: from standing, the end of the lane counts."""
    (end,) = dead_ends(DROP)
    lattice = DROP.lattice
    between_m = 0.5 * (lattice.cell_y_m(0) + lattice.cell_y_m(1))
    standing = (end.line_m - 1.0, 0.0, 0.0, between_m, 0.0, 0.0)
    controller = controller_in((0, 1), DROP, state=standing)
    for tick in range(100):
        controller.step(tick + 200)
        s, _, _, y, _, _ = controller.plant.state
        if y - 0.5 * DROP.vehicle.width_m < lattice.lane_width_m:
            assert s < end.end_m
    assert cell_state(lattice, (0, 1), 0.0)[3] == pytest.approx(y, abs=0.5)


def test_closures_that_are_not_possible_are_refused_in_one_line() -> None:
    def refused(closures: list[dict[str, float]], **more: object) -> str:
        data = {"formation": {"operation": "rolling"}, "road": {"closures": closures}, **more}
        with pytest.raises(ValueError, match="got") as caught:
            parse_scenario(data)
        (line,) = str(caught.value).splitlines()
        return line

    lane_0 = {"lane": 0, "from_m": 800.0}
    assert "at most 2400, since 2 of 3 lanes" in refused(
        [lane_0], demand={"volume_veh_per_lane_h": 2500.0}
    )
    assert "demand.lane_shares: got [1.0, 1.0, 1.0]" in refused(
        [lane_0], demand={"lane_shares": [1, 1, 1]}
    )
    # A formation of seven columns needs more room than a vehicle.
    assert "road.closures[0].from_m: got 550.0; allowed: at least 605: a formation" in refused(
        [lane_0 | {"from_m": 550.0}], formation={}
    )
    assert "demand.volume_veh_per_lane_h: got 1900.0; allowed: at most 1800" in refused(
        [lane_0], formation={}, demand={"volume_veh_per_lane_h": 1900.0}
    )
    structures = [{"from_m": 100.0, "structure": "parallel"}]
    assert "formation.structures" in refused([lane_0], formation={"structures": structures})
    assert "road.closures[0].lane: got 3" in refused([{"lane": 3, "from_m": 800.0}])
    assert "road.closures[0].to_m: got 700.0" in refused([lane_0 | {"to_m": 700.0}])
    assert "road.closures[0].from_m: got 1800.0" in refused([lane_0 | {"from_m": 1800.0}])
    assert "road.closures[1].from_m: got 850.0" in refused(
        [lane_0 | {"to_m": 900.0}, lane_0 | {"from_m": 850.0}]
    )
    assert "road.closures[0].from_m: got 450.0; allowed: at least 545" in refused(
        [lane_0 | {"from_m": 450.0}]
    )
    assert "the end of a lane beside one that is open" in refused(
        [lane_0, {"lane": 1, "from_m": 800.0}]
    )
    assert "road.closures[0].to_m: got 999.0; allowed: at most 905" in refused(
        [lane_0 | {"to_m": 999.0}]
    )
    assert "vehicle.max_accel_mps2: got 0.2" in refused(
        [lane_0], vehicle={"max_accel_mps2": 0.2}, formation={
            "operation": "rolling", "settle_s": 60.0
        },
    )  # fmt: skip
