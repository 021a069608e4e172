"""Where vehicles can stop before a part of a lane that is closed suddenly."""

from __future__ import annotations

import math

from laneweave.protocol.scenario.fields import Scenario

BRAKING_MPS2 = 5.0
"""Deceleration with which a vehicle must be able to stop; less than `HEEDED_BRAKING_MPS2`."""
REACTION_S = 0.5
"""Time until it brakes."""


def stops_before(at_m: float, s_m: float, speed_mps: float) -> bool:
    """Return whether a vehicle can stop before a position that it has not expected."""
    return at_m - s_m >= stopping_m(speed_mps)


def stopping_m(speed_mps: float) -> float:
    """Return the distance in which a vehicle can stop that has not expected to."""
    speed = max(speed_mps, 0.0)
    return speed * REACTION_S + speed * speed / (2.0 * BRAKING_MPS2)


def queue_pitch_m(scenario: Scenario) -> float:
    """Return the distance between the fronts of vehicles that stand in a queue."""
    return scenario.types.longest_body_m + scenario.tracking.min_gap_m


def room_before_part_m(scenario: Scenario, room_m: float) -> float:
    """Return how far behind the beginning of its section a part of a lane may be closed suddenly.

    Vehicles that enter there can stop at the line before the part, `room_m` before it.
    """
    return room_m + stopping_m(scenario.formation.speed_mps)


def begins_m(scenario: Scenario, lane: int, s_m: float) -> float:
    """Return the last position up to `s_m` where a lane begins, or where vehicles enter it.

    Before the start of the road, this is `s_m`.
    """
    sections = (each.from_m for each in scenario.geometry.sections if each.lane == lane)
    entries = (each.at_m for each in scenario.geometry.entry_points if each.lane == lane)
    return max((each for each in (*sections, *entries) if -math.inf < each <= s_m), default=s_m)
