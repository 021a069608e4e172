"""Measurement errors follow the scenario, differ by vehicle, and repeat in equal runs."""

from __future__ import annotations

import attrs
import numpy as np
import pytest
from numpy.typing import NDArray

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Sensing
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import Name, Neighbour
from laneweave.sim_bridge.bodies.overlaps_and_gaps import NO_NEIGHBOURS, ExactNeighbours, Neighbours
from laneweave.sim_bridge.bodies.sensors import Sensors
from support.paper import EXACT

# All different, so that none can stand in for another.
NOISE = Sensing(
    position_noise_m=0.5,
    lateral_noise_m=0.04,
    speed_noise_mps=0.2,
    accel_noise_mps2=0.3,
    gap_noise_m=0.6,
    other_speed_noise_mps=0.7,
    other_accel_noise_mps2=0.8,
)
SCENARIO = Scenario(seed=5, sensing=NOISE)
STATE: State = (120.0, 15.0, -1.0, 5.25, 0.5, 0.25)
AROUND: ExactNeighbours = ([(1, 10.0, 14.0, -2.0), (2, 7.0, 13.0, 1.0)], [(0, 9.0, 16.0, 0.0)])
TRUE_AROUND = Neighbours(
    (Neighbour(1, 10.0, 14.0, -2.0), Neighbour(2, 7.0, 13.0, 1.0)), (Neighbour(0, 9.0, 16.0),)
)
A, B = Name("a"), Name("b")
SAMPLES = 4000


def states(scenario: Scenario = SCENARIO, name: Name = A, samples: int = 20) -> NDArray[np.float64]:
    sensors = Sensors(scenario, name)
    return np.array([sensors.measure(STATE) for _ in range(samples)])


def others(around: Neighbours) -> list[tuple[float, float, float]]:
    return [(n.gap_m, n.speed_mps, n.accel_mps2) for n in (*around.ahead, *around.behind)]


def test_its_own_state_is_unbiased_with_the_configured_error() -> None:
    errors = states(samples=SAMPLES) - STATE
    deviations = np.array([0.5, 0.2, 0.3, 0.04, 0.2, 0.3])
    assert errors.std(axis=0) == pytest.approx(deviations, rel=0.05)
    assert (np.abs(errors.mean(axis=0)) < 4.0 * deviations / SAMPLES**0.5).all()


def test_neighbours_are_unbiased_with_the_configured_error() -> None:
    sensors = Sensors(SCENARIO, A)
    seen = np.array([others(sensors.measure_neighbours(AROUND)) for _ in range(SAMPLES)])
    errors = seen - np.array(others(TRUE_AROUND))
    deviations = np.array([0.6, 0.7, 0.8])
    assert errors.std(axis=0) == pytest.approx(np.tile(deviations, (3, 1)), rel=0.05)
    assert (np.abs(errors.mean(axis=0)) < 4.0 * deviations / SAMPLES**0.5).all()


def test_errors_are_independent_of_each_other_and_over_time() -> None:
    sensors = Sensors(SCENARIO, A)
    rows = [
        np.concatenate([sensors.measure(STATE), *others(sensors.measure_neighbours(AROUND))])
        for _ in range(SAMPLES)
    ]
    errors = np.array(rows) - rows[0]
    together = np.corrcoef(np.hstack([errors[1:], errors[:-1]]).T)
    assert np.abs(together - np.eye(len(together))).max() < 5.0 / SAMPLES**0.5


def test_what_is_seen_keeps_its_lane_and_its_side() -> None:
    seen = Sensors(SCENARIO, A).measure_neighbours(AROUND)
    assert [other.lane for other in seen.ahead] == [1, 2]
    assert [other.lane for other in seen.behind] == [0]
    assert Sensors(SCENARIO, A).measure_neighbours(([], [])) == NO_NEIGHBOURS


def test_errors_are_equal_only_for_the_same_vehicle_and_seed() -> None:
    assert (states() == states()).all()
    one, other = (Sensors(SCENARIO, A).measure_neighbours(AROUND) for _ in range(2))
    assert one == other
    assert (states() != states(name=B)).all()
    assert (states() != states(attrs.evolve(SCENARIO, seed=6))).all()


def test_without_noise_sensors_are_exact() -> None:
    sensors = Sensors(attrs.evolve(SCENARIO, sensing=EXACT), A)
    assert sensors.measure(STATE) == STATE
    assert sensors.measure_neighbours(AROUND) == TRUE_AROUND


def test_no_measured_speed_is_negative() -> None:
    sensors = Sensors(SCENARIO, A)
    standing = [sensors.measure((0.0,) * 6) for _ in range(200)]
    assert min(state[1] for state in standing) == 0.0
    assert min(state[4] for state in standing) < 0.0  # across the road it has no direction
    stopped: ExactNeighbours = ([(0, 4.0, 0.0, 0.0)], [(0, 4.0, 0.0, 0.0)])
    around = [sensors.measure_neighbours(stopped) for _ in range(200)]
    assert min(speed for each in around for _, speed, _ in others(each)) == 0.0
