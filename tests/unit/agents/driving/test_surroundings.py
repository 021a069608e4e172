"""Which neighbours count, where they are predicted, and which are left out."""

from __future__ import annotations

import random

import numpy as np
import pytest
from msgspec.structs import replace

from laneweave.agents.driving.stopping_points import SENSED_S
from laneweave.agents.driving.surroundings import SLOW_S, SLOW_SHARE, Surroundings
from laneweave.agents.driving.tracking_problem import NO_GAPS, Gaps
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State, cell_state, commanded_state
from laneweave.protocol.wire.messages import CurrentMotion, Name, Neighbour, Sense, VehicleRecord
from laneweave.sim_bridge.bodies.plant import Plant

SCENARIO = Scenario()
LIMITS, LATTICE, TICK_S = SCENARIO.vehicle, SCENARIO.lattice, SCENARIO.runtime.tick_s
V_F, LAG_S = LATTICE.speed_mps, LIMITS.actuator_lag_s
LEAST_M = SCENARIO.tracking.min_gap_m
N = SCENARIO.timing.horizon_ticks
TIMES_S = TICK_S * np.arange(N + 1)
KNOWN = TIMES_S <= SENSED_S + 1e-9
HOME: Cell = (0, 1)
AT_HOME = cell_state(LATTICE, HOME, 0.0)


def sense(
    ahead: tuple[Neighbour, ...] = (),
    behind: tuple[Neighbour, ...] = (),
    state: State = AT_HOME,
    setpoint: tuple[float, float] = (0.0, 0.0),
) -> Sense:
    return Sense(
        Name("me"),
        0,
        0.0,
        state,
        HOME,
        CurrentMotion(HOME),
        0,
        VehicleRecord(),
        ahead,
        behind,
        setpoint,
    )


def gaps_of(felt: Sense, lane: int = HOME[1], *, all_of_them: bool = False) -> Gaps:
    """Return the gaps; if wished, also those that the module takes to be out of question."""
    surroundings = Surroundings(SCENARIO, LIMITS)
    if all_of_them:
        surroundings._gain_mps2, surroundings._loss_mps2 = 1e6, -1e6
    state = commanded_state(felt.measured, felt.setpoint, LIMITS, V_F)
    return surroundings.gaps(felt, state, lane)


def off(positions: np.ndarray | None) -> np.ndarray:
    """Return positions relative to the front bumper now."""
    assert positions is not None
    return positions - AT_HOME[0]


# --- lanes ----------------------------------------------------------------------------------------

EVERYWHERE = (Neighbour(0, 4.0, V_F), Neighbour(1, 5.0, V_F), Neighbour(2, 4.5, V_F))


@pytest.mark.parametrize(
    ("across_m", "lane", "gap_m"),
    [
        (0.0, 1, 5.0),  # its own lane only
        (0.0, 2, 4.5),  # and the one that it enters, from the start
        (0.0, 0, 4.0),
        (0.8, 1, 5.0),
        (0.9, 1, 4.5),  # lanes are 3.5 m wide and bodies 1.8 m: it is in two lanes
        (-0.9, 1, 4.0),
        (2.0, 2, 4.5),
        (3.5, 2, 4.5),  # the lane that it has left does not count
    ],
)
def test_it_minds_the_lanes_that_it_touches_and_the_one_that_it_enters(
    across_m: float, lane: int, gap_m: float
) -> None:
    s, v, a, y, v_y, a_y = AT_HOME
    gaps = gaps_of(sense(EVERYWHERE, EVERYWHERE, (s, v, a, y + across_m, v_y, a_y)), lane)
    assert off(gaps.latest)[0] == pytest.approx(gap_m - LEAST_M)
    assert off(gaps.earliest)[0] == pytest.approx(LEAST_M - gap_m)


def test_without_neighbours_ahead_or_behind_there_are_no_gaps_there() -> None:
    assert gaps_of(sense()) is NO_GAPS
    beside = (Neighbour(0, 1.0, V_F), Neighbour(2, 1.0, V_F))
    assert gaps_of(sense(beside, beside)) is NO_GAPS
    near = (Neighbour(1, 4.0, V_F),)
    assert gaps_of(sense(near)).earliest is None
    assert gaps_of(sense((), near)).latest is None


# --- where they will be ---------------------------------------------------------------------------


def test_they_go_on_at_constant_speed_as_long_as_that_may_be_believed() -> None:
    slow, fast = Neighbour(1, 10.0, 9.0), Neighbour(1, 14.0, 24.0)
    assert slow.speed_mps > SLOW_SHARE * V_F
    gaps = gaps_of(sense((slow,), (fast,)))
    lag_m = LAG_S * (9.0 - V_F)
    expected = 10.0 - LEAST_M + lag_m + 9.0 * TIMES_S[KNOWN]
    assert off(gaps.latest)[KNOWN] == pytest.approx(expected)
    expected = LEAST_M - 14.0 + LAG_S * (24.0 - V_F) + 24.0 * TIMES_S[KNOWN]
    assert off(gaps.earliest)[KNOWN] == pytest.approx(expected)
    assert (off(gaps.latest)[~KNOWN] == np.inf).all()
    assert (off(gaps.earliest)[~KNOWN] == -np.inf).all()
    assert 0 < KNOWN.sum() < N


def test_slow_neighbours_ahead_are_predicted_for_longer() -> None:
    """So that a vehicle need not brake hard behind one that stands."""
    known = TIMES_S <= SLOW_S + 1e-9
    standing = Neighbour(1, 30.0, 0.0)
    latest = off(gaps_of(sense((standing,))).latest)
    assert latest[known] == pytest.approx(30.0 - LEAST_M - LAG_S * V_F)
    assert (latest[~known] == np.inf).all()
    assert KNOWN.sum() < known.sum() < N
    behind = (Neighbour(1, 3.0, 1.0),)
    assert (off(gaps_of(sense((), behind), all_of_them=True).earliest)[~KNOWN] == -np.inf).all()


def test_positions_are_commanded_positions_of_the_other_body() -> None:
    """Of equal lag, bodies keep the distance that their commanded states keep."""
    other = Plant((AT_HOME[0] + 10.0 + LIMITS.length_m, 12.0, 0.0, 5.25, 0.0, 0.0), LIMITS, TICK_S)
    for _ in range(3):
        other.step(-12.0, 0.0)
    s, v, a, *_ = other.state
    gap_m = s - LIMITS.length_m - AT_HOME[0]
    gaps = gaps_of(sense((Neighbour(1, gap_m, v, a),)), all_of_them=True)
    pursued = commanded_state(other.state, other.setpoint, LIMITS, V_F)
    rear_m = pursued[0] - LIMITS.length_m - AT_HOME[0]
    expected = rear_m - LEAST_M + pursued[1] * TIMES_S[KNOWN]
    assert off(gaps.latest)[KNOWN] == pytest.approx(expected)


def test_no_vehicle_is_predicted_to_go_backwards() -> None:
    gaps = gaps_of(sense((Neighbour(1, 6.0, 0.5, -8.0),)))
    known = off(gaps.latest)[KNOWN]
    assert known == pytest.approx(np.full(known.shape, known[0]))


def test_of_two_the_nearer_one_counts_at_each_moment() -> None:
    """While it changes lanes: the one behind is faster and passes the other's place."""
    felt = sense((Neighbour(1, 10.0, 5.0), Neighbour(2, 6.0, V_F)))
    each = [
        off(gaps_of(replace(felt, ahead=(one,)), 2, all_of_them=True).latest) for one in felt.ahead
    ]
    both = off(gaps_of(felt, 2, all_of_them=True).latest)
    assert (both == np.minimum(*each)).all()
    assert both[0] == each[1][0] != both[10] == each[0][10]
    felt = replace(felt, ahead=(), behind=(Neighbour(1, 10.0, 22.0), Neighbour(2, 6.0, V_F)))
    each = [
        off(gaps_of(replace(felt, behind=(one,)), 2, all_of_them=True).earliest)
        for one in felt.behind
    ]
    both = off(gaps_of(felt, 2, all_of_them=True).earliest)
    assert (both == np.maximum(*each)).all()
    assert both[0] == each[1][0] != both[10] == each[0][10]


# --- neighbours that are left out -----------------------------------------------------------------


def reach(state: State, accel_mps2: float) -> np.ndarray:
    """Return where the commanded position is at most or at least, as far as others are known."""
    return state[0] + state[1] * TIMES_S + accel_mps2 * TIMES_S**2 / 2.0


def test_neighbours_that_are_left_out_cannot_matter() -> None:
    rng = random.Random(9)
    left_out = {"latest": 0, "earliest": 0}
    counted = dict(left_out)
    for _ in range(3000):
        other = Neighbour(1, rng.uniform(0.0, 25.0), rng.uniform(0.0, 25.0), rng.uniform(-9.0, 5.0))
        s, _, _, y, _, _ = AT_HOME
        state = (s, rng.uniform(0.0, 25.0), rng.uniform(-9.0, 5.0), y, 0.0, 0.0)
        side = rng.choice(("latest", "earliest"))
        ahead, behind = ((other,), ()) if side == "latest" else ((), (other,))
        felt = sense(ahead, behind, state, (state[2], 0.0))
        pursued = commanded_state(state, felt.setpoint, LIMITS, V_F)
        every = getattr(gaps_of(felt, all_of_them=True), side)
        found = getattr(gaps_of(felt), side)
        if found is not None:
            counted[side] += 1
            assert (found == every).all()
        elif side == "latest":
            left_out[side] += 1
            assert (reach(pursued, LIMITS.max_accel_mps2) <= every + 1e-9).all()
        else:
            left_out[side] += 1
            assert (reach(pursued, LIMITS.min_accel_mps2) >= every - 1e-9).all()
    assert min(*left_out.values(), *counted.values()) > 100


@pytest.mark.parametrize("side", ["ahead", "behind"])
def test_a_too_close_neighbour_counts_even_while_the_gap_opens(side: str) -> None:
    opens = Neighbour(1, 2.2, 18.0) if side == "ahead" else Neighbour(1, 1.5, 9.0)
    gaps = gaps_of(sense((opens,), ()) if side == "ahead" else sense((), (opens,)))
    assert gaps is not NO_GAPS
    assert (off(gaps.latest)[0] < 0.0) if side == "ahead" else (off(gaps.earliest)[0] > 0.0)
