"""One window of the lattice as arrays, for the compiled code of the rolling planner.

A window holds the columns that the vehicles on the road can reach, and the slots until the last
vehicle has left the road. Indices: slot s from the current one, column c from the window's lowest,
lane, and displacement d as numbered by `displacements`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
from attrs import evolve
from numpy.typing import NDArray

from laneweave.coordinator.planning.conflict_kinds import ConflictModel, conflict_offsets
from laneweave.coordinator.planning.rolling.paths_kernel import (
    ENTERING,
    FIXED,
    MAX_EJECTED,
    PENALTY,
    UNREACHED,
)
from laneweave.coordinator.planning.rolling.problem import (
    ROUNDING_M,
    StreamCosts,
    StreamRoad,
    StreamVehicle,
)
from laneweave.coordinator.planning.rolling.window_arrays import (
    Bools,
    Costs,
    Floats,
    Ints,
    Paths,
    Saved,
    Scratch,
    Singles,
    Table,
    Window,
)
from laneweave.protocol.lattice import Cell, Mode, displacements

_MAX_RESTRICTED_COST = 1000.0
"""Maximum cost of a path for driving where it may not, far below that of a forbidden move."""
_SAVED = MAX_EJECTED + 32
"""Maximum number of paths saved during a chain or a reordering."""


class _LaneRules(NamedTuple):
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


class _Zones(NamedTuple):
    """Sections, divided where restrictions of groups begin and end."""

    of_cell: NDArray[np.int16]
    """`Table.zone`."""
    section: Ints
    """Section of each zone; -1: none."""
    restricted: Bools
    """Whether each zone is restricted for each group; (groups - 1, zones)."""


def window(
    road: StreamRoad,
    costs: StreamCosts,
    slot: int,
    vehicles: Sequence[StreamVehicle],
    blocked: Collection[Cell],
) -> Window:
    """Return the arrays, without paths yet, for the vehicles on the road, sorted by column."""
    start_m, end_m = road.sorting_m
    # Upper bound on the moves of a vehicle: the slots that it takes to pass S3.
    reach = max(0, int((end_m - start_m) / road.advance_m) + 1)
    low = vehicles[0].cell[0] - reach
    columns = vehicles[-1].cell[0] + reach - low + 1
    now_m = (np.arange(columns) + low) * road.pitch_m + slot * road.advance_m
    rearmost_m = now_m[reach]
    slots = max(1, int(np.ceil((road.length_m - rearmost_m) / road.advance_m)) + 1)
    # Add slots for vehicles that fall back.
    slots += int(np.ceil(reach * road.pitch_m / road.advance_m))
    at_m = now_m + np.arange(slots + 1)[:, None] * road.advance_m
    starts_m = _starts_m(road, at_m[:-1])
    rules = _lane_rules(road, vehicles, slot, at_m, starts_m)
    table, own_zones = _table(road, at_m, starts_m, low, blocked, rules)
    # A path must remain cheaper than one with a forbidden move.
    restricted = costs.cleared if road.cleared else costs.restricted
    costs = evolve(costs, restricted=min(restricted, _MAX_RESTRICTED_COST / slots))
    return Window(
        low,
        table,
        _paths(road, costs, table, low, vehicles, rules, own_zones),
        _costs(costs, table.steps),
        _scratch(len(vehicles), slots, reach, road.lanes),
    )


def _table(
    road: StreamRoad,
    at_m: Floats,
    starts_m: Floats,
    low: int,
    blocked: Collection[Cell],
    rules: _LaneRules,
) -> tuple[Table, _Zones]:
    """Return an empty table and its zones; `at_m`: positions of columns when slots begin."""
    slots, columns = at_m.shape[0] - 1, at_m.shape[1]
    offsets, first = _offsets(road.mode, road.model)
    is_blocked = np.zeros((road.lanes, columns), dtype=np.bool_)
    for column, lane in blocked:
        if 0 <= column - low < columns and 0 <= lane < road.lanes:
            is_blocked[lane, column - low] = True
    steps = displacements(road.mode)
    load = np.zeros((slots, len(steps), road.lanes, columns), dtype=np.float32)
    section, left, latest_m = _sections(road, at_m)
    found = _zones(section, rules.restricted, len(road.sections))
    zone = found.of_cell
    may_move = _may_move(road, starts_m, latest_m, is_blocked)
    load[:, 1:][~may_move] = FIXED * ENTERING
    may_leave: Bools = np.asarray(may_move.any(axis=(1, 2)))
    moving_columns = np.stack(
        [may_leave.argmax(axis=1), columns - 1 - may_leave[:, ::-1].argmax(axis=1)]
    )
    moving_columns[:, ~may_leave.any(axis=1)] = [[columns], [-1]]
    table = Table(
        load,
        np.full((slots, road.lanes, columns), -1, dtype=np.int32),
        np.zeros((slots, road.lanes, columns), dtype=np.int8),
        offsets.copy(),  # the search changes a factor
        first,
        np.array(steps, dtype=np.int64),
        np.ascontiguousarray(moving_columns.T),
        rules.forbidden,
        zone,
        left,
        np.where(left.any(axis=2), left.argmax(axis=2), columns),
        columns - np.logical_and.reduce(left, axis=1)[:, ::-1].cumprod(axis=1).sum(axis=1),
        (zone != zone[:1, :, :1]).any(axis=(0, 2)),
    )
    return table, found


def _lane_rules(
    road: StreamRoad,
    vehicles: Sequence[StreamVehicle],
    first_slot: int,
    at_m: Floats,
    starts_m: Floats,
) -> _LaneRules:
    """Return the rules for vehicles; `at_m`: positions of columns at the beginning of slots."""
    types = [one.vehicle_type for one in vehicles]
    names = [name for name in sorted(set(types)) if road.cleared or road.rules_of(name)]
    numbers = {name: number for number, name in enumerate(names, start=1)}
    slots, columns = at_m.shape[0] - 1, at_m.shape[1]
    later = first_slot + np.arange(slots + 1.0)[:, None]
    steps = displacements(road.mode)
    shape = (len(names), slots, len(steps), road.lanes, columns)
    rules = _LaneRules(
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


def _zones(section: NDArray[np.int16], restricted: Bools, sections: int) -> _Zones:
    """Divide sections where restrictions begin and end.

    Args:
        section: section of each cell at the beginning of each slot; -1: none.
        restricted: `_LaneRules.restricted`.
        sections: number of sections.
    """
    groups = len(restricted)
    if not groups:
        numbers = np.array([*range(sections), -1], dtype=np.int64)
        return _Zones(section, numbers, np.zeros((0, sections + 1), dtype=np.bool_))
    code = section.astype(np.int64) + 1
    for own in restricted:
        code = 2 * code + own
    codes, of_cell = np.unique(code, return_inverse=True)
    bits = [(codes >> (groups - 1 - group)) & 1 for group in range(groups)]
    return _Zones(
        of_cell.reshape(section.shape).astype(np.int16),
        (codes >> groups) - 1,
        np.array(bits, dtype=np.bool_),
    )


def _starts_m(road: StreamRoad, front_m: Floats) -> Floats:
    """Return `StreamRoad.start_m` for positions (slots, columns) of the front, for each lane.

    Shape: (slots, lanes, columns).
    """
    starts_m = np.repeat(front_m[:, None], road.lanes, axis=1)
    for lane, sections in enumerate(road.lane_sections if road.early_m is not None else ()):
        for _, to_m, number in sections:
            begins_m = road.first_m(number)
            later = (front_m < road.line_m(number, to_m)) & (front_m < begins_m)
            later &= begins_m <= front_m + road.advance_m
            np.maximum(starts_m[:, lane], begins_m, out=starts_m[:, lane], where=later)
    return starts_m


def _sections(road: StreamRoad, at_m: Floats) -> tuple[NDArray[np.int16], Bools, Floats]:
    """Return sections, `Table.left`, and where moves have to begin in each slot at the latest.

    The section of a cell is the one in which it is when a slot begins, or beyond whose end; -1:
    none. A move whose front begins there ends before the line of its section; -inf: no section is
    open for the whole body.
    """
    slots, columns = at_m.shape[0] - 1, at_m.shape[1]
    section = np.full((slots + 1, road.lanes, columns), -1, dtype=np.int16)
    left = np.zeros((slots + 1, road.lanes, columns), dtype=np.bool_)
    latest_m = np.full((slots, road.lanes, columns), -np.inf)
    start_m, end_m = road.sorting_m
    for lane, sections in enumerate(road.lane_sections):
        for from_m, to_m, number in sections:
            begun = at_m >= from_m - ROUNDING_M
            section[:, lane][begun] = number
            left[:, lane][begun] = (at_m > to_m + ROUNDING_M)[begun]
            first_m, line_m = road.first_m(number), min(end_m, road.line_m(number, to_m))
            begins = at_m[:-1] - road.body_m >= start_m - ROUNDING_M
            # A move may begin later in the slot, when its lane opens (`StreamRoad.early_m`).
            until_m = at_m[:-1] if road.early_m is None else at_m[1:]
            begins &= until_m >= first_m - ROUNDING_M
            begins &= np.maximum(at_m[:-1], first_m) + road.advance_m <= line_m + ROUNDING_M
            latest_m[:, lane][begins] = line_m - road.advance_m + ROUNDING_M
    return section, left, latest_m


def _may_move(road: StreamRoad, starts_m: Floats, latest_m: Floats, is_blocked: Bools) -> Bools:
    """Return whether each move stays in open cells of S3 and enters no blocked cell.

    The corners of an oblique move count as entered, except the vehicle's own cell. A lane change
    begins when both lanes are open (`starts_m`), and must end before both lines (`latest_m`).
    Shape: (slots, displacements without the first, lanes, columns).
    """
    lanes, columns = is_blocked.shape
    steps = displacements(road.mode)[1:]
    is_open: Bools = starts_m <= latest_m
    allowed = np.zeros((len(is_open), len(steps), lanes, columns), dtype=np.bool_)
    for d, (column, lane) in enumerate(steps):
        here_c = slice(max(0, -column), columns - max(0, column))
        there_c = slice(max(0, column), columns + min(0, column))
        here_l = slice(max(0, -lane), lanes - max(0, lane))
        there_l = slice(max(0, lane), lanes + min(0, lane))
        inside = is_open[:, here_l, here_c] & is_open[:, there_l, there_c]
        if lane and not column:
            begins_m = np.maximum(starts_m[:, here_l], starts_m[:, there_l])
            inside &= begins_m <= np.minimum(latest_m[:, here_l], latest_m[:, there_l])
        free = ~is_blocked[there_l, there_c]
        if column and lane:
            inside &= is_open[:, here_l, there_c] & is_open[:, there_l, here_c]
            free &= ~is_blocked[here_l, there_c] & ~is_blocked[there_l, here_c]
        allowed[:, d, here_l, here_c] = inside & free
    return allowed


def _paths(
    road: StreamRoad,
    costs: StreamCosts,
    table: Table,
    low: int,
    vehicles: Sequence[StreamVehicle],
    rules: _LaneRules,
    own_zones: _Zones,
) -> Paths:
    slots, count = len(table.load), len(vehicles)
    column, lane = np.zeros((2, count, slots + 1), dtype=np.int64)
    column[:, 0] = [vehicle.cell[0] - low for vehicle in vehicles]
    lane[:, 0] = [vehicle.cell[1] for vehicle in vehicles]
    target = np.zeros((count, len(road.sections) + 1), dtype=np.bool_)
    for v, vehicle in enumerate(vehicles):
        target[v, list(vehicle.targets)] = True
    steps = displacements(road.mode)
    held = np.array([vehicle.held for vehicle in vehicles], dtype=np.bool_)
    # Number of slots in which each vehicle may change lanes, ignoring others.
    begin, end = table.moving_columns.T[:, :, None]
    may_move = (begin <= column[:, 0]) & (column[:, 0] <= end)
    stays = np.array([vehicle.waits for vehicle in vehicles], dtype=np.int64)
    may_move &= np.arange(slots)[:, None] >= stays
    chances = may_move.sum(axis=0)
    # Lower bounds on the numbers of slots outside target sections and of moves.
    of_lane = np.array([section.lane for section in road.sections])
    distance = np.abs(lane[:, :1] - of_lane)
    away = np.where(target[:, :-1], distance, road.lanes).min(axis=1)
    waits = np.where(away > 0, may_move.argmax(axis=0), 0)
    min_cost = away * (costs.move + costs.off_lane) + waits * costs.off_lane
    min_cost += chances * min(0.0, costs.forward)
    # In row-major order, for which the kernels are compiled.
    in_target = np.take(target, own_zones.section, axis=1)
    zone_cost = np.where(in_target, 0.0, costs.off_lane)
    zone_cost[:, np.isin(own_zones.section, road.closing)] += costs.closing
    with_rules = rules.group > 0
    zone_cost[with_rules] += costs.restricted * own_zones.restricted[rules.group[with_rules] - 1]
    missing_cost = costs.missing * (1.0 + 1.0 / (1.0 + chances))
    return Paths(
        column,
        lane,
        np.zeros((count, slots), dtype=np.int8),
        np.zeros(count, dtype=np.int64),
        in_target,
        zone_cost.astype(np.float32, order="C"),
        rules.group,
        held,
        stays,
        np.array([[one.drives(*step) for step in steps] for one in vehicles], dtype=np.bool_),
        missing_cost,
        min_cost,
        ~held & (chances >= away),
        missing_cost.copy(),
        np.where(held, FIXED, PENALTY),
        np.zeros(count),
        np.zeros(count, dtype=np.bool_),
    )


def _costs(costs: StreamCosts, steps: Ints) -> Costs:
    of_move = np.where((steps != 0).any(axis=1), costs.move, 0.0)
    of_move += np.where(steps[:, 0] < 0, costs.backward, 0.0)
    of_move += np.where(steps[:, 0] > 0, costs.forward, 0.0)
    return Costs(of_move.astype(np.float32), np.float32(costs.restricted))


def _scratch(count: int, slots: int, reach: int, lanes: int) -> Scratch:
    return Scratch(
        Saved(
            np.zeros(_SAVED, dtype=np.int64),
            np.zeros(_SAVED, dtype=np.int64),
            np.zeros(_SAVED),
            np.zeros((_SAVED, slots), dtype=np.int8),
            *np.zeros((2, _SAVED, slots + 1), dtype=np.int64),
        ),
        np.zeros(count, dtype=np.bool_),
        np.zeros((slots + 1, lanes, 2 * reach + 3), dtype=np.float32),
        np.zeros(slots, dtype=np.float32),
        np.zeros(2 * reach + 3, dtype=np.float32),
        np.zeros(1, dtype=np.int64),
        *np.zeros((5, count + 1), dtype=np.int64),
    )


@lru_cache(maxsize=16)
def _offsets(mode: Mode, model: ConflictModel) -> tuple[Ints, Ints]:
    """Return the conflicts of all displacements in one array, and the first index of each."""
    table = conflict_offsets(mode, model)
    flat = [
        (*entry, 1 if (d, *entry) == (0, 0, 0, 0) else ENTERING)
        for d, entries in enumerate(table)
        for entry in entries
    ]
    first = np.cumsum([0, *(len(entries) for entries in table)])
    return np.array(flat, dtype=np.int64), cast("Ints", first)
