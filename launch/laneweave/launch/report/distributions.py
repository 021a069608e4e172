"""How vehicles drive, as counts over a run: spacing and headway, deceleration and comfort.

Counted are the times at which traffic is neither building up nor thinning out: from the end of the
warm-up (`recorder.py: WARM_UP_S`) to the end of the demand; the whole run where that is too short.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from attrs import field, frozen
from numpy.typing import NDArray

from laneweave.launch.report.trajectories import Floats, Tracks
from laneweave.protocol.scenario.tables import Scenario
from laneweave.sim_bridge.recording.recorder import WARM_UP_S

Bools = NDArray[np.bool_]

LOOK_S: Final = 1.0
"""Spacings are looked at this often; they change slowly."""
LEAST_STEADY_S: Final = 10.0
"""A shorter time between warm-up and last arrival tells nothing."""
STANDING_MPS: Final = 0.5
"""Who is slower has no time headway."""


@frozen(eq=False)
class Quantity:
    """Something that is counted, and how it is shown."""

    name: str
    unit: str
    edges: Floats
    """Of its bins; the last one takes all that is beyond, too."""
    exceedance: bool
    """Shown as the share of driving time in which it is at least so large; else as the share of
    vehicles that have less."""


def _centred(step: float, last: float) -> Floats:
    """Return edges of bins whose centres are the multiples of a step."""
    return np.asarray(np.arange(-0.5, last / step + 1.0) * step, dtype=np.float64)


SPACING: Final = Quantity("spacing", "m", _centred(0.5, 90.0), exceedance=False)
"""Front bumper to front bumper of the next vehicle ahead on the lane."""
HEADWAY: Final = Quantity("time headway", "s", _centred(0.05, 6.0), exceedance=False)
"""Spacing over the speed of the one behind."""
DECELERATION: Final = Quantity("deceleration", "m/s²", np.linspace(0.0, 10.0, 201), exceedance=True)
JERK: Final = Quantity("jerk", "m/s³", np.linspace(0.0, 20.0, 201), exceedance=True)
"""Change of acceleration along the road from tick to tick."""
LATERAL: Final = Quantity(
    "lateral acceleration", "m/s²", np.linspace(0.0, 5.0, 201), exceedance=True
)
"""Second difference of the place across the road over three ticks."""


@frozen
class Counts:
    """Of each quantity, how often it was in each of its bins."""

    of: dict[str, Floats] = field(factory=dict)

    def __add__(self, other: Counts) -> Counts:
        """Return the counts of both."""
        names = dict.fromkeys([*self.of, *other.of])
        return Counts(
            {name: np.asarray(self.of.get(name, 0.0) + other.of.get(name, 0.0)) for name in names}
        )

    def cumulative(self, quantity: Quantity) -> Floats:
        """Return the share that is less than each upper edge but the last."""
        counts = self.of[quantity.name]
        return np.asarray(np.cumsum(counts)[:-1] / max(1.0, counts.sum()))

    def exceedance(self, quantity: Quantity) -> Floats:
        """Return the share that is at least as large as each edge but the last."""
        counts = self.of[quantity.name]
        return np.asarray(np.cumsum(counts[::-1])[::-1] / max(1.0, counts.sum()))


def count(tracks: Tracks, scenario: Scenario) -> Counts:
    """Count all quantities over a run."""
    steady = _steady(tracks, scenario)
    spacing_m, headway_s = _spacings(tracks, scenario, steady)
    same = (np.diff(tracks.vehicle) == 0) & steady[1:] & steady[:-1]
    dt_s = np.where(same, np.diff(tracks.t_s), 1.0)
    jerk = np.abs(np.diff(tracks.accel_mps2) / dt_s)[same]
    lateral_mps = np.diff(tracks.y_m) / dt_s
    both = same[1:] & same[:-1]
    lateral_mps2 = np.abs(np.diff(lateral_mps) / dt_s[1:])[both]
    values = {
        SPACING: spacing_m,
        HEADWAY: headway_s,
        DECELERATION: np.maximum(0.0, -tracks.accel_mps2[steady]),
        JERK: jerk,
        LATERAL: lateral_mps2,
    }
    return Counts(
        {quantity.name: _histogram(found, quantity.edges) for quantity, found in values.items()}
    )


def _steady(tracks: Tracks, scenario: Scenario) -> Bools:
    if scenario.demand.duration_s < WARM_UP_S + LEAST_STEADY_S:
        return np.ones(len(tracks.t_s), dtype=np.bool_)
    return (tracks.t_s >= WARM_UP_S) & (tracks.t_s <= scenario.demand.duration_s)


def _spacings(tracks: Tracks, scenario: Scenario, steady: Bools) -> tuple[Floats, Floats]:
    """Return (spacings m, time headways s) of all that have somebody ahead on their lane."""
    look = np.rint(tracks.t_s / LOOK_S)
    chosen = steady & (np.abs(tracks.t_s - look * LOOK_S) < 0.5 * scenario.runtime.tick_s)
    lane = np.clip(tracks.y_m // scenario.road.lane_width_m, 0, scenario.road.lanes - 1)
    look, lane, s_m, speed_mps = (
        values[chosen] for values in (look, lane, tracks.s_m, tracks.speed_mps)
    )
    order = np.lexsort((s_m, lane, look))
    look, lane, s_m, speed_mps = (values[order] for values in (look, lane, s_m, speed_mps))
    follows = (np.diff(look) == 0) & (np.diff(lane) == 0)
    spacing_m, behind_mps = np.diff(s_m)[follows], speed_mps[:-1][follows]
    moving = behind_mps > STANDING_MPS
    return spacing_m, spacing_m[moving] / behind_mps[moving]


def _histogram(values: Floats, edges: Floats) -> Floats:
    last = 0.5 * (edges[-2] + edges[-1])
    return np.histogram(np.clip(values, edges[0], last), edges)[0].astype(np.float64)
