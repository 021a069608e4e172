"""What a motion controller drives by: play, hold, give way, emergency, and what leads where."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from laneweave.protocol.lattice import Cell
from laneweave.protocol.vehicle.motion import State, cell_state, commanded_state, hold_law
from laneweave.protocol.wire.messages import Neighbour
from laneweave.sim_bridge.bodies.motion_controller import RELEASE_M, FallbackLevel
from laneweave.sim_bridge.bodies.overlaps_and_gaps import NO_NEIGHBOURS, Neighbours
from laneweave.sim_bridge.bodies.plant import Plant
from support.paper import PAPER
from support.road_vehicles import controller_in
from support.states import command

SCENARIO = PAPER
LIMITS, LATTICE, TICK_S = SCENARIO.vehicle, SCENARIO.lattice, SCENARIO.runtime.tick_s
V_F = LATTICE.speed_mps
HOME: Cell = (0, 1)


class Track:
    """A vehicle with exact sensors, and perhaps one ahead at constant speed."""

    def __init__(self, state: State | None = None) -> None:
        """Put it into its cell, alone."""
        self.controller = controller_in(HOME, state=state)
        self.plant = self.controller.plant
        self.tick = 0
        self.rear_m, self.speed_mps, self.lane = np.inf, V_F, HOME[1]
        self.min_accel_mps2 = 0.0

    def put_ahead(self, gap_m: float, speed_mps: float, lane: int = HOME[1]) -> None:
        self.rear_m, self.speed_mps, self.lane = self.plant.state[0] + gap_m, speed_mps, lane

    @property
    def gap_m(self) -> float:
        return float(self.rear_m - self.plant.state[0])

    def command(self, *pairs: tuple[float, float], hold_cell: Cell = HOME) -> None:
        assert self.controller.accept_command(command(self.tick, *pairs, hold_cell=hold_cell))

    def step(self) -> FallbackLevel:
        around = NO_NEIGHBOURS
        if np.isfinite(self.rear_m):
            around = Neighbours((Neighbour(self.lane, self.gap_m, self.speed_mps),), ())
        self.controller.perceive(self.plant.state, around)
        self.controller.step(self.tick)
        self.min_accel_mps2 = min(self.min_accel_mps2, self.plant.state[2])
        self.rear_m += self.speed_mps * TICK_S
        self.tick += 1
        return self.controller.level

    def run(self, ticks: int) -> list[FallbackLevel]:
        return [self.step() for _ in range(ticks)]


@pytest.fixture
def track() -> Track:
    made = Track()
    made.command(hold_cell=HOME)  # a process is in charge but sends no jerks
    made.tick += 1
    return made


# --- the levels -------------------------------------------------------------------------------


def test_it_plays_a_command_as_long_as_it_could_still_brake(track: Track) -> None:
    """Four metres behind one that is as fast: nothing that it would do by itself."""
    track.put_ahead(4.0, V_F)
    track.command(*[(0.0, 0.0)] * 40)
    assert set(track.run(40)) == {FallbackLevel.EXECUTE}
    assert track.plant.state[1] == V_F


def test_holding_is_the_hold_law_for_the_commanded_state(track: Track) -> None:
    track.command((6.0, 4.0), (6.0, 4.0))
    track.run(2)
    plant = track.plant
    pursued = commanded_state(plant.state, plant.setpoint, LIMITS, V_F)
    goal = cell_state(LATTICE, HOME, track.tick * TICK_S)
    expected = Plant(plant.state, LIMITS, TICK_S)
    expected._setpoint = plant.setpoint
    expected.step(*hold_law(pursued, goal, LIMITS, TICK_S))
    track.step()
    assert plant.state == expected.state


@pytest.mark.parametrize(("speed_mps", "lane"), [(0.0, 1), (7.0, 1), (0.0, 2)])
def test_a_holding_vehicle_gives_way_comfortably_on_its_target_lane(
    track: Track, speed_mps: float, lane: int
) -> None:
    track.command(hold_cell=(0, lane))
    track.put_ahead(40.0, speed_mps, lane)
    gaps = [track.gap_m for _ in range(300) if track.step()]
    assert min(gaps) > SCENARIO.tracking.min_gap_m - 0.1
    assert track.plant.state[1] == pytest.approx(speed_mps, abs=0.1)
    assert track.min_accel_mps2 >= 0.6 * LIMITS.min_accel_mps2 - 1e-9
    ticks = track.controller.level_ticks
    assert ticks[FallbackLevel.GIVE_WAY] > 20
    assert ticks[FallbackLevel.EMERGENCY] == ticks[FallbackLevel.EXECUTE] == 0


def test_vehicles_on_other_lanes_are_not_in_its_way(track: Track) -> None:
    for lane in (0, 2):
        track.put_ahead(40.0, 0.0, lane)
        assert set(track.run(60)) == {FallbackLevel.HOLD}
        assert track.gap_m < -20.0


# --- emergencies ----------------------------------------------------------------------------------


def test_an_emergency_overrides_the_command(track: Track) -> None:
    track.put_ahead(16.0, 0.0)
    track.command(*[(0.0, 0.0)] * 40)
    levels = track.run(40)
    first = levels.index(FallbackLevel.EMERGENCY)
    assert set(levels[:first]) <= {FallbackLevel.EXECUTE}
    assert FallbackLevel.EXECUTE not in levels[first:]
    assert levels[first : first + 12] == [FallbackLevel.EMERGENCY] * 12
    assert track.min_accel_mps2 < -9.5
    assert track.plant.state[1] == pytest.approx(0.0, abs=0.01)
    assert track.gap_m > 0.2


def test_an_emergency_ends_in_a_hold_and_only_a_fresh_command_leads_back_up(track: Track) -> None:
    track.command(*[(0.0, 0.0)] * 60)
    track.put_ahead(9.0, 8.0)
    assert track.run(2)[-1] is FallbackLevel.EMERGENCY
    track.rear_m = np.inf
    assert (
        track.run(30) == [FallbackLevel.HOLD] * 30
    )  # the trajectory would have gone on all the time
    track.command(hold_cell=HOME)  # it has nothing to play
    assert track.step() is FallbackLevel.HOLD
    track.command(*[(1.0, 0.0)] * 3)
    assert track.run(4) == [FallbackLevel.EXECUTE] * 3 + [FallbackLevel.HOLD]


def test_after_an_emergency_it_gives_way_behind_a_slow_vehicle(track: Track) -> None:
    track.command(*[(0.0, 0.0)] * 40)
    track.put_ahead(8.0, 6.0)
    levels = track.run(120)
    order = [
        level for level, before in zip(levels, [None, *levels], strict=False) if level is not before
    ]
    assert order[0] is FallbackLevel.EMERGENCY
    assert FallbackLevel.EXECUTE not in order
    assert order[-1] is FallbackLevel.GIVE_WAY
    assert track.plant.state[1] == pytest.approx(6.0, abs=0.3)
    assert track.gap_m > 1.0


def test_a_fresh_command_does_not_end_an_emergency(track: Track) -> None:
    track.put_ahead(16.0, 0.0)
    for _ in range(30):
        track.command(*[(15.0, 0.0)] * 40)
        level = track.step()
    assert level is FallbackLevel.EMERGENCY
    assert track.gap_m > 0.2


def test_an_emergency_ends_only_when_something_is_to_spare() -> None:
    """So one favourable error of measurement does not release the brake."""
    track, brakes = Track(), []
    plant, controller = track.plant, track.controller
    enough_m = RELEASE_M + V_F * TICK_S
    for wanted_m in (enough_m / 2.0, -0.01, enough_m / 2.0, enough_m + 0.1):
        track.command((0.0, 0.0))
        level = Neighbour(HOME[1], 0.0, V_F)
        spare_m = controller._brake.spare_m(plant.state, plant.setpoint[0], (0.0, 0.0), [level])
        other = replace(level, gap_m=wanted_m - spare_m)
        controller.perceive(plant.state, Neighbours((other,), ()))
        controller.step(track.tick)
        track.tick += 1
        brakes.append(controller.level is FallbackLevel.EMERGENCY)
    assert brakes == [False, True, True, False]


@pytest.mark.parametrize("lane", [0, 1, 2])
def test_it_brakes_for_a_lane_that_it_enters_before_the_body_touches_it(
    track: Track, lane: int
) -> None:
    """From the moment the move begins; the one beside stands 12 m ahead."""
    track.put_ahead(12.0, 0.0, lane)
    track.command(*[(0.0, 0.0)] * 40, hold_cell=(0, 2))
    level = track.step()
    y_m = track.plant.state[3]
    assert int((y_m + LIMITS.width_m / 2.0) // LATTICE.lane_width_m) == HOME[1]
    assert (level is FallbackLevel.EMERGENCY) == (lane in {1, 2})


@pytest.mark.parametrize(("across_m", "brakes"), [(0.0, False), (0.8, False), (0.9, True)])
def test_it_brakes_for_a_lane_that_the_body_touches(across_m: float, *, brakes: bool) -> None:
    """Lanes are 3.5 m wide and bodies 1.8 m: more than 0.85 m off, it is in two lanes."""
    s, v, a, y, *_ = cell_state(LATTICE, HOME, 0.0)
    track = Track((s, v, a, y + across_m, 0.0, 0.0))
    track.put_ahead(12.0, 0.0, lane=2)
    assert (track.step() is FallbackLevel.EMERGENCY) == brakes


def test_a_vehicle_behind_is_no_emergency(track: Track) -> None:
    track.controller.perceive(track.plant.state, Neighbours((), (Neighbour(HOME[1], -2.0, 25.0),)))
    track.controller.step(track.tick)
    assert track.controller.level is FallbackLevel.HOLD


def test_it_steers_on_while_it_brakes(track: Track) -> None:
    track.put_ahead(12.0, 0.0)
    track.command(*[(0.0, 8.0)] * 40)
    track.step()
    assert track.controller.level is FallbackLevel.EMERGENCY
    assert track.plant.setpoint == pytest.approx((LIMITS.min_accel_mps2, 0.8))


# --- what it measures -----------------------------------------------------------------------------


def test_it_drives_by_what_its_sensors_measure_in_this_tick() -> None:
    track = Track()
    s, *rest = track.plant.state
    track.controller.perceive((s - 2.0, *rest), NO_NEIGHBOURS)  # type: ignore[arg-type]
    assert track.controller.measured[0] == s - 2.0
    assert track.controller.moving(0)
    track.controller.step(0)
    assert track.plant.setpoint[0] > 0.1
    assert track.controller.measured == track.plant.state
