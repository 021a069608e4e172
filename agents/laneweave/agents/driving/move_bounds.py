"""Bounds on moves by a column: room to brake, and time to collision, both linear in the state."""

from __future__ import annotations

from attrs import frozen

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.timing import MIN_TTC_S, longest_ttc_s
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.emergency_brake import (
    ERROR_SIGMAS,
    last_tick_m,
    lead_lag_s,
    lead_path_m,
    own_braking_mps2,
    spare_error_m,
)

TRACKING_ERROR_M = 0.25
"""Margin for tracking errors behind the vehicle ahead."""
CLOSING_SPEEDUP = 0.5
"""Maximum closing speed that the tangents cover, as a fraction of v_F."""
_APPROACH_SHARE = 0.59
"""Minimum time to collision of a gentle forward move, as a fraction of the longest possible one. A
vehicle that closes up early brakes for longer, and burns no fuel meanwhile."""


@frozen
class Envelope:
    """Bound on position and speed that leaves room to brake behind a vehicle that holds."""

    ticks: int
    """Reaction time [ticks]."""
    brake_mps2: float
    max_m: float
    """Upper bound of s + (v_F + v)^2 / (2 brake), with s and v relative to the lattice."""

    @classmethod
    def behind(cls, scenario: Scenario, limits: Vehicle, gap_m: float) -> Envelope:
        """Return the envelope for a move that starts with a net gap of `gap_m` to the vehicle."""
        speed_mps, braking = scenario.formation.speed_mps, scenario.braking
        ticks = max(round(braking.reaction_s / scenario.runtime.tick_s), 1)
        lost_s = limits.actuator_lag_s + ticks * scenario.runtime.tick_s
        closing_mps = (1.0 + CLOSING_SPEEDUP) * speed_mps
        errors_m = ERROR_SIGMAS * spare_error_m(
            limits, braking, scenario.sensing, closing_mps, speed_mps
        )
        brake_mps2, tick_s = own_braking_mps2(limits, braking), scenario.runtime.tick_s
        kept_m = braking.margin_m + errors_m + TRACKING_ERROR_M + last_tick_m(brake_mps2, tick_s)
        lead_m = lead_path_m(speed_mps, 0.0, braking.lead_brake_mps2, lead_lag_s(limits, braking))
        max_m = gap_m + lead_m - kept_m - lost_s * speed_mps
        return cls(ticks, brake_mps2, max_m)


@frozen
class TtcBound:
    """Lower bound on the time to collision with a vehicle that holds beyond the target."""

    gap_m: float
    """Net gap to that vehicle at the start of the move."""
    ttc_s: float
    direction: int
    """1: it holds ahead, -1: behind."""


def ttc_bounds(dx: int, gap_m: float, pitch_m: float, duration_s: float) -> tuple[TtcBound, ...]:
    """Return the bounds that a move by `dx` columns should keep, the longest time first."""
    if dx == 0:
        return ()
    longest_s = longest_ttc_s(gap_m, pitch_m, duration_s)
    approach_s = max(MIN_TTC_S, _APPROACH_SHARE * longest_s) if dx > 0 else MIN_TTC_S
    times_s = sorted({approach_s, MIN_TTC_S}, reverse=True)
    return tuple(TtcBound(gap_m, ttc_s, dx) for ttc_s in times_s)
