"""Distances between vehicles at the lattice's fixed time points, from a run's trajectories.

At the end of each slot the vehicles that moved in the slot are at rest in a cell, and two vehicles
in a lane are at least d_F apart, front to front. In between, they may be closer by design, for
example when one falls back into a cell while another leaves it.

Slots differ between plans. The ticks examined are those before a vehicle begins a move, and one per
shortest T_F. The vehicles examined in these ticks are at rest: they have been on the road for at
least `formation.settle_s`, and either are about to begin a move or have been in the same cell for
at least the longest time of a move. Lanes and distances are those of the bodies, so that a body
outside its cell is detected.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from attrs import frozen

from laneweave.launch.recordings.trajectories import NO_LATTICE, Bools, Floats, Ints, Tracks
from laneweave.protocol.scenario.fields import Scenario

TOLERANCE_M: Final = 0.3
"""Permitted error of a distance: each body is tracked to within 0.1 m at lattice points, sensors
err by 0.05 m (standard deviation), and the errors of both bodies may add up."""


@frozen
class LatticeSpacing:
    """Distances at the lattice points of a run."""

    least_m: float | None
    """Minimum distance from front bumper to front bumper; None: no two vehicles in a lane."""
    pairs: int
    """Number of distances examined."""
    worst_off_m: float | None
    """Maximum distance of a vehicle at rest from its cell along the road."""

    def keeps(self, pitch_m: float) -> bool:
        """Return whether all distances are at least the pitch d_F, within the tolerance."""
        return self.least_m is None or self.least_m >= pitch_m - TOLERANCE_M


def lattice_spacing(tracks: Tracks, scenario: Scenario) -> LatticeSpacing:
    """Measure the distances between vehicles at rest at the ends of slots.

    Args:
        tracks: the run's trajectories.
        scenario: scenario of the run.
    """
    lattice = scenario.lattice
    ticks = np.rint(tracks.t_s / scenario.runtime.tick_s).astype(np.int64)
    rows = np.flatnonzero(_settled(tracks, ticks, scenario))
    lane = tracks.lane[rows]
    order = np.lexsort((tracks.s_m[rows], lane, ticks[rows]))
    rows, lane = rows[order], lane[order]
    follows = (np.diff(ticks[rows]) == 0) & (np.diff(lane) == 0)
    spacing_m = np.diff(tracks.s_m[rows])[follows]
    rest_m = lattice.speed_mps * tracks.t_s[rows] + lattice.pitch_m * tracks.reserved_column[rows]
    off_m = np.abs(tracks.s_m[rows] - rest_m)
    return LatticeSpacing(
        least_m=round(float(spacing_m.min()), 3) if len(spacing_m) else None,
        pairs=len(spacing_m),
        worst_off_m=round(float(off_m.max()), 3) if len(off_m) else None,
    )


def _settled(tracks: Tracks, ticks: Ints, scenario: Scenario) -> Bools:
    """Return whether each row is a lattice point of a vehicle at rest in a cell."""
    formation, tick_s = scenario.formation, scenario.runtime.tick_s
    first, changed = np.zeros(len(ticks), dtype=np.bool_), tracks.changed
    first[tracks.starts[:-1]] = True
    about_to_move = np.append(changed[1:], False)[: len(ticks)]
    shortest_s, longest_s = scenario.timing.cycles_s
    period = round(shortest_s / tick_s)
    at_end: Bools = ticks % period == _slot_phase(ticks[changed], period)
    at_end |= np.isin(ticks, ticks[about_to_move])
    on_road_s = tracks.t_s - _since(tracks.t_s, first)
    held_s = tracks.t_s - _since(tracks.t_s, first | changed)
    min_held_s = np.where(about_to_move, shortest_s, longest_s) - formation.slack_s
    rests: Bools = held_s >= min_held_s - 0.5 * tick_s
    rests &= on_road_s >= formation.settle_s - 0.5 * tick_s
    rests &= tracks.reserved_column != NO_LATTICE
    return rests & at_end


def _slot_phase(changes: Ints, period: int) -> int:
    """Return the tick of a period at which slots end: most cells change in the next tick.

    A vehicle reports its next cell in the first tick of its move.
    """
    if not len(changes):
        return 0
    return int(np.bincount((changes - 1) % period, minlength=period).argmax())


def _since(t_s: Floats, marks: Bools) -> Floats:
    """Return the time of the last mark up to each row; the first row counts as marked."""
    places = np.maximum.accumulate(np.where(marks, np.arange(len(t_s)), 0))
    return np.asarray(t_s[places])
