"""Spacing at lattice points: examined vehicles, distances, and the tolerance."""

from __future__ import annotations

import numpy as np
import pytest
from attrs import evolve

from evaluation.lattice_points import TOLERANCE_M, lattice_spacing
from evaluation.points import slow_stretch, within_limits
from laneweave.launch.recordings.trajectories import NO_LATTICE, Tracks
from laneweave.protocol.config.scenario_files import load_scenario
from support.tracks import make_tracks

SCENARIO = load_scenario(None)
LATTICE = SCENARIO.lattice
TICKS = np.arange(0, 401)
"""40 s: ten slots."""
Vehicle = tuple[int, int, float]
"""(column, lane, metres ahead of its cell)."""


def parked(*vehicles: Vehicle) -> Tracks:
    """Return vehicles that hold their cells for 40 s."""
    t_s = TICKS * SCENARIO.runtime.tick_s
    return make_tracks(
        t_s,
        len(vehicles),
        s_m=[LATTICE.speed_mps * t_s + LATTICE.pitch_m * c + ahead_m for c, _, ahead_m in vehicles],
        y_m=[LATTICE.cell_y_m(lane) for _, lane, _ in vehicles],
        speed_mps=[LATTICE.speed_mps] * len(vehicles),
        reserved_column=[column for column, _, _ in vehicles],
        lane=[lane for _, lane, _ in vehicles],
    )


def moved(tracks: Tracks, vehicle: int, slot: int, column: int) -> Tracks:
    """Return tracks in which a vehicle moves to another column in a slot."""
    rows = tracks.rows(vehicle)
    begin, end = rows.start + 40 * slot, rows.start + 40 * (slot + 1)
    columns, s_m = tracks.reserved_column.copy(), tracks.s_m.copy()
    steps = column - int(columns[begin])
    columns[begin + 1 : rows.stop] = column
    s_m[begin:end] += np.linspace(0.0, steps * LATTICE.pitch_m, 40)
    s_m[end : rows.stop] += steps * LATTICE.pitch_m
    return evolve(tracks, reserved_column=columns, s_m=s_m)


def test_spacing_is_from_front_to_front_on_a_lane() -> None:
    found = lattice_spacing(parked((0, 0, 0.0), (2, 0, 0.1), (1, 1, -0.05)), SCENARIO)
    assert found.least_m == pytest.approx(30.1)
    assert found.worst_off_m == pytest.approx(0.1)
    # From 10 s (`settle_s`) to 40 s there are eight ends of slots of 4 s.
    assert found.pairs == 8
    assert found.keeps(LATTICE.pitch_m)


@pytest.mark.parametrize(
    ("near_m", "kept"), [(TOLERANCE_M - 0.01, True), (TOLERANCE_M + 0.01, False)]
)
def test_too_near(near_m: float, *, kept: bool) -> None:
    found = lattice_spacing(parked((0, 0, near_m), (1, 0, 0.0)), SCENARIO)
    assert found.least_m == pytest.approx(15.0 - near_m)
    assert found.keeps(LATTICE.pitch_m) is kept


def test_distances_are_those_of_bodies_not_of_cells() -> None:
    found = lattice_spacing(parked((0, 0, 0.0), (1, 0, -12.0)), SCENARIO)
    assert found.least_m == pytest.approx(3.0)
    assert found.worst_off_m == pytest.approx(12.0)


def test_distances_between_lattice_points_are_ignored() -> None:
    """A vehicle enters a cell that another leaves; both are at rest only at the ends of slots."""
    tracks = moved(parked((0, 0, 0.0), (2, 0, 0.0)), 0, slot=4, column=1)
    assert np.diff(tracks.s_m.reshape(2, -1), axis=0).min() == pytest.approx(15.0)
    found = lattice_spacing(tracks, SCENARIO)
    assert found.least_m == pytest.approx(15.0)
    assert found.worst_off_m == pytest.approx(0.0)


def test_slots_may_end_at_any_tick() -> None:
    """Formations have different time points, which follow from the changes of cells."""
    tracks = moved(parked((0, 0, 0.0), (2, 0, 0.0)), 0, slot=4, column=1)
    shifted = evolve(tracks, t_s=tracks.t_s + 2.3, s_m=tracks.s_m + 2.3 * LATTICE.speed_mps)
    found = lattice_spacing(shifted, SCENARIO)
    assert found.least_m == pytest.approx(15.0)
    assert found.worst_off_m == pytest.approx(0.0)


def test_vehicles_that_have_just_entered_do_not_count() -> None:
    late = evolve(SCENARIO, formation=evolve(SCENARIO.formation, settle_s=39.0))
    found = lattice_spacing(parked((0, 0, 0.0), (1, 0, -9.0)), late)
    assert found.pairs == 1
    later = evolve(SCENARIO, formation=evolve(SCENARIO.formation, settle_s=41.0))
    assert lattice_spacing(parked((0, 0, 0.0), (1, 0, -9.0)), later).least_m is None


def test_without_a_lattice_no_distance_is_examined() -> None:
    tracks = parked((0, 0, 0.0), (1, 0, -9.0))
    found = lattice_spacing(
        evolve(tracks, reserved_column=np.full_like(tracks.reserved_column, NO_LATTICE)), SCENARIO
    )
    assert (found.least_m, found.pairs, found.worst_off_m) == (None, 0, None)
    assert lattice_spacing(make_tracks(np.empty(0), 0), SCENARIO).pairs == 0


def test_limits() -> None:
    assert within_limits(-10.0004, 5.0, SCENARIO)
    assert within_limits(None, None, SCENARIO)
    assert not within_limits(-10.01, 4.0, SCENARIO)
    assert not within_limits(-9.0, 5.01, SCENARIO)


def test_the_congested_stretch() -> None:
    scenario = load_scenario(None, demand__duration_s=100.0)
    tracks = parked((0, 0, 0.0))
    slow = (tracks.s_m > 300.0) & (tracks.s_m < 400.0)
    # Between warm-up and last arrival: 60 to 100 s.
    tracks = evolve(tracks, t_s=tracks.t_s + 60.0, speed_mps=np.where(slow, 3.0, 15.0))
    assert slow_stretch(tracks, scenario) == ((300.0, 400.0), 3.0, 3.0)
    # Vehicles settle on the first 150 m, in 10 s.
    settling = tracks.s_m < 150.0
    slower = evolve(tracks, speed_mps=np.where(settling, 2.0, tracks.speed_mps))
    assert slow_stretch(slower, scenario) == ((0.0, 400.0), 2.0, 3.0)
    assert slow_stretch(evolve(tracks, speed_mps=np.full(401, 15.0)), scenario) == (
        None, 15.0, 15.0,
    )  # fmt: skip
    assert slow_stretch(evolve(tracks, t_s=tracks.t_s - 60.0), scenario) == (None, None, None)
