"""Where vehicles may not drive or change lanes, as arrays for the rolling planner."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from laneweave.coordinator.planning.rolling.paths_kernel import UNREACHED
from laneweave.coordinator.planning.rolling.problem import (
    ROUNDING_M,
    StreamRoad,
    StreamVehicle,
)
from laneweave.protocol.lattice import displacements

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]


class LaneRules(NamedTuple):
    """Where vehicles may not drive or change lanes because of their type.

    Types to which restrictions or solid lines apply form *groups*. Lane changes that are forbidden
    are never planned. Driving on in a lane that is restricted ahead is not forbidden, since a
    vehicle that has no room beside it must drive on; it only has a high cost.
    """

    group: Ints
    """Group of each vehicle; 0: no rules apply to it."""
    forbidden: Singles
    """`Table.forbidden`."""
    restricted: Bools
    """Whether a vehicle that stays in a lane drives where it may not, in the slot that begins in a
    cell; (groups - 1, slots + 1, lanes, columns)."""


class Zones(NamedTuple):
    """Sections, divided where restrictions of groups begin and end."""

    of_cell: NDArray[np.int16]
    """`Table.zone`."""
    section: Ints
    """Section of each zone; -1: none."""
    restricted: Bools
    """Whether each zone is restricted for each group; (groups - 1, zones)."""


def lane_rules(
    road: StreamRoad,
    vehicles: Sequence[StreamVehicle],
    first_slot: int,
    at_m: Floats,
    starts_m: Floats,
) -> LaneRules:
    """Return the rules for vehicles; `at_m`: positions of columns at the beginning of slots."""
    types = [one.vehicle_type for one in vehicles]
    names = [name for name in sorted(set(types)) if road.cleared or road.rules_of(name)]
    numbers = {name: number for number, name in enumerate(names, start=1)}
    slots, columns = at_m.shape[0] - 1, at_m.shape[1]
    later = first_slot + np.arange(slots + 1.0)[:, None]
    steps = displacements(road.mode)
    shape = (len(names), slots, len(steps), road.lanes, columns)
    rules = LaneRules(
        np.array([numbers.get(name, 0) for name in types], dtype=np.int64),
        np.zeros(shape, dtype=np.float32),
        np.zeros((len(names), slots + 1, road.lanes, columns), dtype=np.bool_),
    )
    if not names:
        return rules
    for name, forbidden, restricted in zip(names, rules.forbidden, rules.restricted, strict=True):
        for (lane, to_lane), from_m, to_m in road.forbidden_changes(name, later[:-1]):
            if not 0 <= min(lane, to_lane) <= max(lane, to_lane) < road.lanes:
                continue
            start_m = np.maximum(starts_m[:, lane], starts_m[:, to_lane])
            for d, (column, side) in enumerate(steps):
                if side == to_lane - lane:
                    rear_m = start_m - road.body_m + min(0, column) * road.pitch_m
                    front_m = start_m + road.advance_m + max(0, column) * road.pitch_m
                    is_there = (rear_m < to_m - ROUNDING_M) & (front_m > from_m + ROUNDING_M)
                    forbidden[:, d, lane][is_there] = UNREACHED
        for lane, from_m, to_m in road.places_to_leave(name, later):
            restricted[:, lane] |= (at_m - road.body_m < to_m - ROUNDING_M) & (
                at_m + road.advance_m > from_m + ROUNDING_M
            )
    return rules


def zones(section: NDArray[np.int16], restricted: Bools, sections: int) -> Zones:
    """Divide sections where restrictions begin and end.

    Args:
        section: section of each cell at the beginning of each slot; -1: none.
        restricted: `LaneRules.restricted`.
        sections: number of sections.
    """
    groups = len(restricted)
    if not groups:
        numbers = np.array([*range(sections), -1], dtype=np.int64)
        return Zones(section, numbers, np.zeros((0, sections + 1), dtype=np.bool_))
    code = section.astype(np.int64) + 1
    for own in restricted:
        code = 2 * code + own
    codes, of_cell = np.unique(code, return_inverse=True)
    bits = [(codes >> (groups - 1 - group)) & 1 for group in range(groups)]
    return Zones(
        of_cell.reshape(section.shape).astype(np.int16),
        (codes >> groups) - 1,
        np.array(bits, dtype=np.bool_),
    )
