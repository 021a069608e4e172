"""The driver takes motions over, ends them when the body is there, and tracks or is silent."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from laneweave.agents.driving.driver import Drive, SolverStats, TrackingDriver
from laneweave.agents.driving.motions import REPEAT_TICKS
from laneweave.agents.driving.reference import Window
from laneweave.agents.driving.tracker import Tracker, TrackResult
from laneweave.agents.driving.tracking_problem import NO_GAPS, Gaps
from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import (
    ARRIVED_ACROSS_M,
    ARRIVED_ALONG_M,
    State,
    cell_state,
    integrate,
    limited_jerk,
)
from laneweave.protocol.wire.messages import CurrentMotion, Neighbour, Sense
from laneweave.protocol.wire.process_messages import Report
from laneweave.protocol.wire.topics import SENSE
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel
from laneweave.sim_bridge.bodies.plant import Plant
from support.agent_rig import HOME, LATTICE, ME, MOVE_TICKS, SCENARIO, TICK_S, up_and_running
from support.driving import Road
from support.paper import EXACT
from support.states import sense_in, sent

N = SCENARIO.timing.horizon_ticks
MOVE: PlannedMove = (0, HOME, (-1, 2))


class Probe(Tracker):
    """A tracker that can be broken, and records the gaps that it was given."""

    def __init__(self, scenario: Scenario) -> None:
        """Begin unbroken."""
        super().__init__(scenario, scenario.vehicle)
        self.broken = False
        self.gaps = NO_GAPS
        self.state: State | None = None

    def rest(self, state: State, goal: State) -> TrackResult | None:
        """Leave everything to the program, which can be broken."""
        del state, goal
        return None

    def solve(self, state: State, window: Window, gaps: Gaps = NO_GAPS) -> TrackResult:
        self.state, self.gaps = state, gaps
        result = super().solve(state, window, gaps)
        if self.broken:
            return attrs.evolve(result, usable=False, jerk=np.full_like(result.jerk, np.nan))
        return result


def sense(
    tick: int = 10,
    cell: Cell = HOME,
    *,
    off: tuple[float, float] = (0.0, 0.0),
    **more: Any,  # noqa: ANN401 (fields)
) -> Sense:
    """Return what a vehicle senses that is `off` metres from its cell, along and across."""
    s, v, a, y, v_y, a_y = cell_state(LATTICE, cell, tick * TICK_S)
    return sense_in(cell, tick, **{"measured": (s + off[0], v, a, y + off[1], v_y, a_y), **more})


def driver() -> TrackingDriver:
    """Return a driver that holds the home cell since tick 10."""
    made = TrackingDriver(SCENARIO, SCENARIO.vehicle)
    made.take_over(sense())
    return made


def with_probe(made: TrackingDriver, scenario: Scenario = SCENARIO) -> Probe:
    """Replace the tracker of a driver."""
    made._tracker = probe = Probe(scenario)
    return probe


def probed() -> tuple[TrackingDriver, Probe]:
    made = driver()
    return made, with_probe(made)


def follow(made: TrackingDriver, scenario: Scenario, ticks: int) -> tuple[Drive, dict[str, Any]]:
    """Let a driver begin its move at tick 10 and drive a body; return how far both have come."""
    plant = Plant(sense().measured, scenario.vehicle, TICK_S)
    for tick in range(10, 10 + ticks):
        felt = sense(tick, measured=plant.state, setpoint=plant.setpoint)
        drive = made.drive(felt, moving=True)
        plant.step(*jerks(drive)[0].tolist())
    return drive, {"measured": plant.state, "setpoint": plant.setpoint}


def jerks(drive: Drive) -> NDArray[np.float64]:
    return np.frombuffer(drive.jerks, "<f4").reshape(-1, 2).astype(float)


def play(state: State, drive: Drive) -> State:
    """Play all jerks of a drive, one for each tick."""
    for along, across in jerks(drive).tolist():
        state = integrate(
            state, limited_jerk(state, (along, across), SCENARIO.vehicle, TICK_S), TICK_S
        )
    return state


# --- references -------------------------------------------------------------------------------


def test_holding_has_no_end_and_jerks_for_a_whole_horizon() -> None:
    drive = driver().drive(sense(), moving=False)
    assert drive.motion == CurrentMotion(HOME)
    assert jerks(drive) == pytest.approx(np.zeros((N, 2)), abs=1e-4)


def test_a_move_ends_after_its_time_and_its_horizon_ends_in_the_target() -> None:
    made = driver()
    made.begin(MOVE, 10, MOVE_TICKS)
    drive = made.drive(sense(), moving=True)
    assert drive.motion == CurrentMotion(HOME, 10 + MOVE_TICKS, MOVE_TICKS)
    end = play(sense().measured, drive)
    assert end == pytest.approx(cell_state(LATTICE, MOVE[2], (10 + N) * TICK_S), abs=0.02)


@pytest.mark.parametrize(
    ("scenario", "ticks"), [(SCENARIO, MOVE_TICKS), (Scenario(), 44), (Scenario(), 68)]
)
def test_a_motion_under_way_is_taken_over_where_it_is(scenario: Scenario, ticks: int) -> None:
    """A new process knows no plan: the motion controller has kept how long the move takes."""
    made = TrackingDriver(scenario, scenario.vehicle)
    made.take_over(sense())
    made.begin(MOVE, 10, ticks)
    drive, body = follow(made, scenario, 20)
    assert drive.motion == CurrentMotion(HOME, 10 + ticks, ticks)
    felt = sense(30, MOVE[2], motion=drive.motion, **body)
    heir = TrackingDriver(scenario, scenario.vehicle)
    heir.take_over(felt)
    assert not heir.at_rest(felt)
    theirs, mine = made.drive(felt, moving=True), heir.drive(felt, moving=True)
    assert mine.motion == drive.motion
    assert jerks(mine) == pytest.approx(jerks(theirs), abs=1e-3)
    assert heir.motion(10 + 2 * REPEAT_TICKS) == (HOME, MOVE[2], 10, ticks)


@pytest.mark.parametrize(
    ("end_tick", "ticks"),
    [*((end_tick, MOVE_TICKS) for end_tick in (0, 9, 25)),
     *((48, ticks) for ticks in (0, MOVE_TICKS - 1, 2**63 - 1, -1))],
)  # fmt: skip
def test_a_motion_that_is_over_or_of_an_impossible_duration_is_taken_over_as_a_hold(
    end_tick: int, ticks: int
) -> None:
    made, felt = TrackingDriver(SCENARIO, SCENARIO.vehicle), sense(25, MOVE[2])
    made.take_over(replace(felt, motion=CurrentMotion(HOME, end_tick, ticks)))
    assert made.at_rest(felt)
    drive = made.drive(felt, moving=False)
    assert drive.motion == CurrentMotion(MOVE[2])


@pytest.mark.parametrize("origin", [(40, 1), (-3, 2)])
def test_a_motion_that_does_not_lead_to_a_neighbouring_cell_is_taken_over_as_a_hold(
    origin: Cell,
) -> None:
    made, felt = TrackingDriver(SCENARIO, SCENARIO.vehicle), sense(25, MOVE[2])
    made.take_over(replace(felt, motion=CurrentMotion(origin, 48, MOVE_TICKS)))
    assert made.drive(felt, moving=False).motion == CurrentMotion(MOVE[2])


# --- the end of a motion ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tick", "off", "rests"),
    [
        (10 + MOVE_TICKS, (0.0, 0.0), True),
        (10 + MOVE_TICKS + 50, (0.0, 0.0), True),
        (10 + MOVE_TICKS - 1, (0.0, 0.0), False),
        (10 + MOVE_TICKS, (ARRIVED_ALONG_M - 0.01, ARRIVED_ACROSS_M - 0.01), True),
        (10 + MOVE_TICKS, (-ARRIVED_ALONG_M + 0.01, -ARRIVED_ACROSS_M + 0.01), True),
        (10 + MOVE_TICKS, (-ARRIVED_ALONG_M - 0.01, 0.0), False),
        (10 + MOVE_TICKS, (0.0, ARRIVED_ACROSS_M + 0.01), False),
    ],
)
def test_a_motion_ends_when_its_time_is_over_and_the_body_is_in_the_target(
    tick: int, off: tuple[float, float], rests: bool
) -> None:
    made = driver()
    made.begin(MOVE, 10, MOVE_TICKS)
    assert made.at_rest(sense(tick, MOVE[2], off=off)) is rests
    assert not made.at_rest(sense(tick, HOME))  # the cell that it came from


def test_a_late_motion_has_an_end_in_the_future() -> None:
    """A process that takes over must not mistake the end of the time for the end of the motion."""
    made = driver()
    made.begin(MOVE, 10, MOVE_TICKS)
    tick = 10 + MOVE_TICKS + 5
    late = sense(tick, MOVE[2], off=(-2.0, 0.0))
    assert made.drive(late, moving=True).motion.end_tick == tick + 1
    assert made.drive(late, moving=False).motion.end_tick == 0


# --- what is tracked --------------------------------------------------------------------------


def test_the_commanded_state_is_tracked_and_not_the_bodys() -> None:
    """What the set-point is about to do needs no correction."""
    made, probe = probed()
    s, v, a, y, v_y, a_y = sense().measured
    made.drive(
        sense(measured=(s, v + 0.4, a - 0.5, y, v_y, a_y), setpoint=(0.7, 0.2)), moving=False
    )
    lag_s = SCENARIO.vehicle.actuator_lag_s
    expected = (s + lag_s * 0.4, v + 0.4 - lag_s * 0.5, 0.7, y, v_y, 0.2)
    assert probe.state == pytest.approx(expected)


LEAST_M = SCENARIO.tracking.min_gap_m


@pytest.mark.parametrize(("moving", "gap_m"), [(False, 4.5), (True, 4.0)])
def test_gaps_are_kept_on_the_own_lane_and_from_the_start_of_a_move_on_the_target_lane(
    *, moving: bool, gap_m: float
) -> None:
    made, probe = probed()
    if moving:
        made.begin(MOVE, 10, MOVE_TICKS)
    felt = sense(ahead=(Neighbour(0, 3.0, 15.0), Neighbour(1, 4.5, 15.0), Neighbour(2, 4.0, 15.0)))
    made.drive(felt, moving=moving)
    assert probe.gaps.latest is not None
    assert probe.gaps.latest[0] == pytest.approx(felt.measured[0] + gap_m - LEAST_M)


# --- when tracking fails ----------------------------------------------------------------------


def test_an_unusable_answer_leaves_what_is_being_played() -> None:
    made, probe = probed()
    made.begin(MOVE, 10, MOVE_TICKS)
    assert len(jerks(made.drive(sense(), moving=True))) == N
    probe.broken = True
    for ticks in (3, 4, 20):
        drive = made.drive(sense(10 + ticks), moving=True)
        assert drive == Drive(CurrentMotion(HOME, 10 + MOVE_TICKS, MOVE_TICKS), b"")


def test_a_usable_answer_ends_the_silence() -> None:
    made, probe = probed()
    probe.broken = True
    assert made.drive(sense(11), moving=False).jerks == b""
    probe.broken = False
    felt = sense(12, off=(-1.0, 0.0))
    drive = made.drive(felt, moving=False)
    assert jerks(drive)[0, 0] > 1.0
    assert drive == driver().drive(felt, moving=False)


def test_meanwhile_the_body_goes_on_with_the_last_good_trajectory_and_then_holds() -> None:
    """With exact sensors the body moves as if nothing had failed."""
    scenario = attrs.evolve(SCENARIO, sensing=EXACT)
    broken_at = 25
    roads = [Road(scenario, {ME: HOME}) for _ in range(2)]
    for road in roads:
        probe = with_probe(road.driven[ME].driver, scenario)
        for _ in range(10 + 4 * N):
            probe.broken = road is roads[1] and road.tick > broken_at
            road.step({ME: MOVE} if road.tick == 10 else None)
    good, bad = (road.record.states for road in roads)
    trajectory = slice(0, broken_at + N + 1)
    assert np.array(bad)[trajectory] == pytest.approx(np.array(good)[trajectory], abs=1e-4)
    controller = roads[1].vehicles[ME].controller
    assert controller.level_ticks == {
        FallbackLevel.EXECUTE: broken_at + N, FallbackLevel.HOLD: 10 + 4 * N - broken_at - N,
        FallbackLevel.GIVE_WAY: 0, FallbackLevel.EMERGENCY: 0,
    }  # fmt: skip
    goal = cell_state(LATTICE, MOVE[2], roads[1].tick * TICK_S)
    assert bad[-1][0] == pytest.approx(goal, abs=0.01)


def test_solver_stats_count_solves_and_failures() -> None:
    made, probe = probed()
    assert made.solver_stats == SolverStats()
    for tick, broken in ((10, False), (11, True), (12, True), (13, False)):
        probe.broken = broken
        made.drive(sense(tick), moving=False)
    stats = made.solver_stats
    assert (stats.solves, stats.unusable) == (4, 2)
    solve_ms = np.frombuffer(stats.solve_ms, "<f4")
    assert len(solve_ms) == 4
    assert (solve_ms >= 0.0).all()


def test_an_agent_with_a_broken_tracker_finishes_its_move_and_reports_the_failures() -> None:
    rig = up_and_running()
    made = rig.agent._driver
    assert isinstance(made, TrackingDriver)
    probe = with_probe(made)
    rig.accept(MOVE)
    rig.run(5)
    probe.broken = True
    state = rig.run(150)
    assert (state.completed, state.moving) == (1, False)
    assert rig.off(MOVE[2]) < 0.3
    (report,) = sent(rig.hand(SENSE, rig.sense(left=True)), Report)
    assert (report.solves, report.unusable) == (rig.tick, 150)
