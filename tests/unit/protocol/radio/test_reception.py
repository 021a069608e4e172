"""The sidelink against the published curves."""

from __future__ import annotations

import numpy as np
import pytest

from laneweave.protocol.radio.reception import (
    DISTANCES_M,
    MAX_DENSITY_PER_KM,
    CellularSidelink,
    DsrcSidelink,
    Floats,
    Sidelink,
    sidelink_of,
)
from laneweave.protocol.scenario.radio_table import C_V2X, DSRC

PUBLISHED_M = np.arange(0.0, 501.0, 100.0)
ANALYTICAL = {
    (100.0, 23.0): (0.990, 0.976, 0.961, 0.907, 0.821, 0.593),
    (200.0, 20.0): (0.989, 0.954, 0.901, 0.765, 0.554, 0.226),
    (300.0, 23.0): (0.988, 0.929, 0.872, 0.701, 0.528, 0.338),
}
"""C-V2X at 10 Hz: curves published with [1] (github.com/msepulcre/C-V2X), by density and power."""
SIMULATED = {
    (C_V2X, 100.0, 10.0, 23.0): (0.991, 0.979, 0.970, 0.937, 0.856, 0.644),
    (C_V2X, 200.0, 10.0, 20.0): (0.986, 0.945, 0.906, 0.784, 0.558, 0.247),
    (C_V2X, 300.0, 10.0, 23.0): (0.989, 0.934, 0.875, 0.724, 0.550, 0.366),
    (DSRC, 60.0, 10.0, 23.0): (0.983, 0.963, 0.852, 0.297, 0.019, 0.001),
    (DSRC, 120.0, 10.0, 23.0): (0.972, 0.937, 0.767, 0.247, 0.015, 0.000),
    (DSRC, 120.0, 25.0, 15.0): (0.951, 0.770, 0.128, 0.001, 0.000, 0.000),
}
"""Network simulations with which the authors validated their models ([1]; [2] and
github.com/msepulcre/IEEE802.11p-model): technology, density, rate, power."""


def at_published(sidelink: Sidelink, density_per_km: float) -> Floats:
    return np.asarray(np.interp(PUBLISHED_M, DISTANCES_M, sidelink.arrival(density_per_km)))


@pytest.mark.parametrize(("density_per_km", "power_dbm"), ANALYTICAL)
def test_c_v2x_equals_the_published_curves(density_per_km: float, power_dbm: float) -> None:
    found = at_published(CellularSidelink(power_dbm, 10.0), density_per_km)
    assert found == pytest.approx(ANALYTICAL[density_per_km, power_dbm], abs=0.0015)


@pytest.mark.parametrize(("technology", "density_per_km", "rate_hz", "power_dbm"), SIMULATED)
def test_curves_are_as_near_to_simulations_as_the_papers_say(
    technology: str, density_per_km: float, rate_hz: float, power_dbm: float
) -> None:
    found = at_published(sidelink_of(technology, power_dbm, rate_hz), density_per_km)
    expected = SIMULATED[technology, density_per_km, rate_hz, power_dbm]
    assert np.abs(found - expected).mean() < 0.025
    assert found == pytest.approx(expected, abs=0.055)


@pytest.mark.parametrize("kind", [CellularSidelink, DsrcSidelink])
@pytest.mark.parametrize("power_dbm", [0.0, 23.0, 33.0])
@pytest.mark.parametrize("rate_hz", [1.0, 10.0, 50.0])
def test_shares_fall_with_distance_and_load(
    kind: type[Sidelink], power_dbm: float, rate_hz: float
) -> None:
    sidelink = kind(power_dbm, rate_hz)
    densities = (0.0, 50.0, 200.0, MAX_DENSITY_PER_KM, 1e6)
    curves = np.array([sidelink.arrival(one) for one in densities])
    assert ((curves >= 0.0) & (curves <= 1.0)).all()
    assert (np.diff(curves, axis=1) <= 0.01).all()
    assert (curves[0] >= curves[1] - 1e-9).all()
    assert (curves[1] >= curves[2] - 0.01).all()
    assert (curves[2] >= curves[3] - 0.01).all()
    assert (curves[3] == curves[4]).all()
    assert curves[0, 0] > 0.9
    assert curves[:, -1].max() < 0.6


def test_more_power_reaches_farther() -> None:
    for kind in (CellularSidelink, DsrcSidelink):
        halves = [
            float(DISTANCES_M[kind(power_dbm, 10.0).arrival(20.0) > 0.5].max())
            for power_dbm in (0.0, 10.0, 23.0, 30.0)
        ]
        assert halves == sorted(set(halves))


def test_path_loss_of_winner_b1() -> None:
    sidelink = CellularSidelink(23.0, 10.0)
    for distance_m, expected_db in (
        (0.0, 57.395),  # as at 3 m: 20 log10(3) + 46.4 + 20 log10(5.91 / 5), free space
        (50.0, 81.832),  # free space
        (150.0, 91.829),  # 22.7 log10(150) + 27 + 20 log10(5.91)
        (500.0, 111.509),  # beyond 177 m: 40 log10(500) + 7.56 - 34.6 log10(1.5) + 2.7 log10(5.91)
    ):
        for sign in (-1.0, 1.0):
            found = sidelink.path_loss_db(np.array([sign * distance_m]))
            assert found == pytest.approx([expected_db], abs=1e-3)
