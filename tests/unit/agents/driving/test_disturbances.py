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
    response = respond(Case("column", drop_mps=3.0, vehicles=4))
    speeds, gaps = response.speed_mps, response.gap_m
    assert speeds[:, 0].min() == pytest.approx(-3.0, abs=0.3)
    assert response.times_s[speeds[:, 0].argmin()] == pytest.approx(BRAKING_S, abs=0.5)
    assert np.abs(speeds[-1]).max() < NOISE_MPS
    # The vehicle behind holds its cell: it only sees the gap shrink.
    assert gaps[:, 1].min() == pytest.approx(response.position_m[:, 0].min(), abs=0.2)
    assert np.abs(speeds[:, 1:]).max() < NOISE_MPS


def test_a_disturbance_that_takes_the_gap_makes_followers_brake() -> None:
    response = respond(Case("column", drop_mps=6.0, vehicles=4))
    assert response.braked > 0
    assert response.overlaps == 0
    assert (response.speed_mps.min(axis=0) < -3.0).all()


@pytest.mark.more
def test_a_lane_change_is_disturbed_and_its_own_motion_is_no_error() -> None:
    response = respond(Case("switching", drop_mps=3.0, vehicles=9))
    assert response.moves > 0
    assert response.speed_mps[:, 0].min() == pytest.approx(-3.0, abs=0.3)
    assert abs(response.speed_mps[0, 0]) < NOISE_MPS
    assert response.overlaps == 0
