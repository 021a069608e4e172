"""Types of vehicles: size, limits and moves of each, and what follows from all of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property

from attrs import frozen

from laneweave.protocol.lattice import Cell, displacements
from laneweave.protocol.scenario.formation_table import FormationSettings
from laneweave.protocol.scenario.vehicle_tables import (
    PEAK_ACCEL,
    PEAK_JERK,
    Vehicle,
    VehicleTypeSettings,
)
from laneweave.protocol.wire.messages import CAR

GAP_AHEAD_M = 9.0
"""Least net gap of a vehicle that changes lanes while it still falls back to its cell."""
MAX_ROOM_AHEAD_M = 6.0
"""Maximum distance from which it falls back meanwhile."""


@frozen
class VehicleType:
    """A type of vehicle."""

    name: str
    limits: Vehicle
    """Size and limits."""
    moves: frozenset[Cell]
    """The moves (columns, lanes) that are planned for the type."""

    @property
    def changes_columns(self) -> bool:
        """Whether the type moves between columns."""
        return any(columns for columns, _ in self.moves)


@frozen
class VehicleTypes(Mapping[str, VehicleType]):
    """The types of vehicles of a scenario by name, cars first.

    Cars drive every move of the mode if `formation.change_columns` is set. Other types do not
    change columns if their limits along the road are lower than such a move needs
    (`column_move_limits`).
    """

    _cars: Vehicle
    _others: tuple[VehicleTypeSettings, ...]
    _formation: FormationSettings
    _cycle_s: float
    """The shortest T_F."""

    def __getitem__(self, name: str) -> VehicleType:
        """Return the type with a name."""
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        """Yield the names."""
        return iter(self._by_name)

    def __len__(self) -> int:
        """Return the number of types."""
        return len(self._by_name)

    @cached_property
    def _by_name(self) -> dict[str, VehicleType]:
        limits = {CAR: self._cars} | {one.name: one.limits(self._cars) for one in self._others}
        return {name: VehicleType(name, own, self._moves(own)) for name, own in limits.items()}

    def _moves(self, limits: Vehicle) -> frozenset[Cell]:
        """Return the moves that are planned for a type with some limits."""
        needed = self.column_move_limits
        if self._formation.change_columns and all(
            abs(getattr(limits, name)) >= limit for name, limit in needed.items()
        ):
            return self._moves_of_mode
        return frozenset(move for move in self._moves_of_mode if move[0] == 0)

    @property
    def _moves_of_mode(self) -> frozenset[Cell]:
        """All moves (columns, lanes) of the mode."""
        return frozenset(displacements(self._formation.mode)[1:])

    def moves_of(self, name: str) -> frozenset[Cell] | None:
        """Return the moves (columns, lanes) that are planned for a type; None: all of the mode.

        There are none for a type that the scenario does not have.
        """
        moves = self[name].moves if name in self else frozenset()
        return None if moves == self._moves_of_mode else moves

    @property
    def column_move_limits(self) -> dict[str, float]:
        """Limits along the road that suffice for a move by a column in the shortest T_F.

        Keys are fields of table `vehicle`, values are absolute. They are the peaks of a
        minimum-jerk move over d in T, `PEAK_ACCEL` d / T^2 and `PEAK_JERK` d / T^3, or those of
        cars, if these are lower: the trajectory of a car keeps within its limits.
        """
        d_m, cars = self._formation.gap_m, self._cars
        move_s = self._cycle_s - self._formation.slack_s
        accel_mps2, jerk_mps3 = PEAK_ACCEL * d_m / move_s**2, PEAK_JERK * d_m / move_s**3
        return {
            "max_accel_mps2": min(accel_mps2, cars.max_accel_mps2),
            "min_accel_mps2": min(accel_mps2, -cars.min_accel_mps2),
            "max_jerk_mps3": min(jerk_mps3, cars.max_jerk_mps3),
        }

    @property
    def all_change_columns(self) -> bool:
        """Whether all types move between columns."""
        return all(one.changes_columns for one in self.values())

    @cached_property
    def weakest_braking(self) -> Vehicle:
        """Limits of the type with the least maximum deceleration."""
        return max((one.limits for one in self.values()), key=lambda one: one.min_accel_mps2)

    @cached_property
    def longest_body_m(self) -> float:
        """Length of the longest type of vehicle."""
        return max(one.limits.length_m for one in self.values())

    @cached_property
    def widest_body_m(self) -> float:
        """Width of the widest type of vehicle."""
        return max(one.limits.width_m for one in self.values())

    @property
    def step_m(self) -> float:
        """Distance that a vehicle needs for one move, with the length of the longest body."""
        return self._formation.speed_mps * self._cycle_s + self.longest_body_m

    @cached_property
    def room_ahead_m(self) -> float:
        """How far ahead of its cell a vehicle that settles may be when it changes lanes.

        All others stay in their columns, so the net gap to the cell ahead is at least
        `GAP_AHEAD_M`. 0 if vehicles change columns.
        """
        if self._formation.change_columns:
            return 0.0
        room_m = self._formation.gap_m - self.longest_body_m - GAP_AHEAD_M
        return min(max(room_m, 0.0), MAX_ROOM_AHEAD_M)
