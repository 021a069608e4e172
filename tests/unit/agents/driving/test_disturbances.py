"""The rig of benchmarks/stability.py: real roles on the simulated network, one vehicle braked."""

from __future__ import annotations

import numpy as np
import pytest

from support.disturbances import BRAKING_S, Case, respond

pytestmark = pytest.mark.slow

NOISE_MPS = 0.2
"""More than errors of sensors and tracking make of a speed."""


def test_an_undisturbed_column_has_no_error_beyond_noise() -> None:
    response = respond(Case("column", drop_mps=0.0, vehicles=4))
    assert response.speed_mps.shape == (len(response.times_s), 4)
    assert np.abs(response.speed_mps).max() < NOISE_MPS
    assert (response.braked, response.overlaps, response.moves) == (0, 0, 0)


def test_the_disturbed_vehicle_loses_its_speed_and_gets_it_back() -> None:
    response = respond(Case("column", drop_mps=2.0, vehicles=4))
    speeds, gaps = response.speed_mps, response.gap_m
    assert speeds[:, 0].min() == pytest.approx(-2.0, abs=0.3)
    assert response.times_s[speeds[:, 0].argmin()] == pytest.approx(BRAKING_S, abs=0.5)
    assert np.abs(speeds[-1]).max() < NOISE_MPS
    # The vehicle behind holds its cell: it only sees the gap shrink.
    assert gaps[:, 1].min() == pytest.approx(response.position_m[:, 0].min(), abs=0.2)
    assert np.abs(speeds[:, 1:]).max() < NOISE_MPS


@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_a_disturbance_that_takes_the_gap_becomes_smaller_from_vehicle_to_vehicle(
    loss: float,
) -> None:
    response = respond(Case("column", drop_mps=8.0, loss=loss, vehicles=6))
    peaks = np.abs(response.speed_mps).max(axis=0)
    assert peaks[0] == pytest.approx(8.0, abs=0.5)
    assert peaks[1] > 3.0  # it does reach the next one
    assert (peaks[1:] < peaks[:-1] + NOISE_MPS).all()
    assert peaks[-1] < 0.6 * peaks[0]
    assert (response.braked, response.overlaps) == (0, 0)
    assert response.least_gap_m > 2.0
    assert response.back_s < 20.0


@pytest.mark.more
def test_a_lane_change_is_disturbed_and_its_own_motion_is_no_error() -> None:
    response = respond(Case("switching", drop_mps=3.0, vehicles=9))
    assert response.moves > 0
    assert response.speed_mps[:, 0].min() == pytest.approx(-3.0, abs=0.3)
    assert abs(response.speed_mps[0, 0]) < NOISE_MPS
    assert response.overlaps == 0
