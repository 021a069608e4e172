"""What a vehicle observes before it chooses a move, and which moves the road allows.

All values are in [-1, 1]. First come `OWN` values of the vehicle itself, then `PER_CELL` values for
each cell around it: of all lanes, from `columns` behind to `columns` ahead of its own column, with
the rearmost column first, then lane 0 first. A vehicle knows these from its sensors and from the
messages STATE and CENSUS, which all vehicles may receive.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from attrs import field, frozen
from numpy.typing import NDArray

from laneweave.coordinator.planning.rolling.problem import StreamRoad, StreamVehicle
from laneweave.coordinator.planning.rolling.requested_moves import is_possible
from laneweave.protocol.lattice import Cell, displacements, footprint
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import READY_LATE_S
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.road.vehicle import RoadVehicle

Observation = NDArray[np.float32]
Mask = NDArray[np.int8]

OWN: Final = (
    "position",
    "to_moves",
    "to_end",
    "lane",
    "to_target",
    "speed",
    "along",
    "across",
    "moving",
    "refused",
)
"""Values of the vehicle itself; docs/ENVIRONMENT.md has their units."""
PER_CELL: Final = ("occupied", "to_target", "open")
"""Values of each cell around the vehicle."""


@frozen
class Observer:
    """Observations and action masks for one scenario."""

    scenario: Scenario
    road: StreamRoad
    columns: int
    """Number of columns that are observed ahead, and behind."""
    moves: tuple[Cell, ...] = field(init=False)
    """Displacement of each action; action 0 is to hold."""
    _targets: dict[tuple[int, str, str], frozenset[int]] = field(factory=dict)
    """Sections by whose ends vehicles may leave, by preferred lane and destination."""

    def __attrs_post_init__(self) -> None:
        """Read the moves of the scenario's mode."""
        object.__setattr__(self, "moves", displacements(self.scenario.formation.mode))

    @property
    def size(self) -> int:
        """Number of values of an observation."""
        cells = (2 * self.columns + 1) * self.scenario.road.lanes
        return len(OWN) + len(PER_CELL) * cells

    def observe(
        self, vehicles: Mapping[Name, RoadVehicle], refused: Iterable[str], t_s: float
    ) -> dict[str, Observation]:
        """Return the observation of each vehicle at a road time.

        Args:
            vehicles: all vehicles on the road.
            refused: those whose last request was not granted.
            t_s: road time of the end of the last tick.
        """
        not_granted, lanes = {*refused}, self.scenario.road.lanes
        held = {one.cell: one for one in vehicles.values() if one.has_cell}
        columns = [column for column, _ in held] or [0]
        low = min(columns) - self.columns
        around = np.zeros((max(columns) + self.columns + 1 - low, lanes, len(PER_CELL)), np.float32)
        for (column, lane), other in held.items():
            around[column - low, lane, :2] = 1.0, self._to_target(other)
        around[:, :, 2] = self._open_cells(range(low, low + len(around)), t_s)
        found: dict[str, Observation] = {}
        for name, vehicle in vehicles.items():
            first = vehicle.cell[0] - self.columns - low
            cells = np.zeros((2 * self.columns + 1, lanes, len(PER_CELL)), np.float32)
            if vehicle.has_cell:
                cells = around[first : first + 2 * self.columns + 1]
            own = self._own(vehicle, t_s, refused=name in not_granted)
            values = np.concatenate([np.array(own, np.float32), cells.ravel()])
            found[name] = np.clip(values, -1.0, 1.0)
        return found

    def masks(self, vehicles: Mapping[Name, RoadVehicle], slot: int) -> dict[str, Mask]:
        """Return, per vehicle, 1 for each move in a slot that may be granted.

        The road and its type allow the move, and it needs no cell that another vehicle holds.
        Requests that conflict with those of others are refused nevertheless.
        """
        held = {one.cell for one in vehicles.values() if one.has_cell}
        found: dict[str, Mask] = {}
        for name, vehicle in vehicles.items():
            mask = self.only_hold()
            if vehicle.has_cell:
                planned = self._planned(name, vehicle, slot)
                cell = planned.cell
                for number, move in enumerate(self.moves):
                    entered = footprint(cell, (cell[0] + move[0], cell[1] + move[1])) - {cell}
                    if entered.isdisjoint(held) and is_possible(self.road, slot, planned, move):
                        mask[number] = 1
            found[name] = mask
        return found

    def only_hold(self) -> Mask:
        """Return the mask of a vehicle that can only hold."""
        mask = np.zeros(len(self.moves), np.int8)
        mask[0] = 1
        return mask

    def _planned(self, name: str, vehicle: RoadVehicle, slot: int) -> StreamVehicle:
        """Return a vehicle as the planner sees it."""
        slot_s = self.scenario.timing.cycles_s[0]
        waits = math.ceil((vehicle.ready_s - READY_LATE_S) / slot_s - slot - 1e-9)
        moves = self.scenario.types.moves_of(vehicle.arrival.vehicle_type)
        targets = self._targets_of(vehicle)
        return StreamVehicle(
            name,
            vehicle.cell,
            targets,
            moves=moves,
            waits=max(0, waits),
            vehicle_type=vehicle.arrival.vehicle_type,
        )

    def _targets_of(self, vehicle: RoadVehicle) -> frozenset[int]:
        own = vehicle.arrival
        wanted = own.preferred_lane, own.destination, own.vehicle_type
        if wanted not in self._targets:
            self._targets[wanted] = self.scenario.geometry.goal_sections(*wanted)
        return self._targets[wanted]

    def _to_target(self, vehicle: RoadVehicle) -> float:
        """Return the lanes to the nearest target lane, left positive, by the largest distance."""
        sections, lane = self.scenario.geometry.sections, vehicle.cell[1]
        distances = [sections[number].lane - lane for number in self._targets_of(vehicle)]
        return min(distances, key=abs, default=0) / max(self.scenario.road.lanes - 1, 1)

    def _open_cells(self, columns: range, t_s: float) -> NDArray[np.bool_]:
        """Return whether the lane is open where each cell is now: (columns, lanes)."""
        lattice = self.scenario.lattice
        at_m = np.array([lattice.cell_s_m(column, t_s) for column in columns])[:, None]
        is_open = np.zeros((len(columns), self.scenario.road.lanes), np.bool_)
        for section in self.scenario.geometry.sections:
            inside = (section.from_m <= at_m) & (at_m <= section.to_m)
            is_open[:, section.lane : section.lane + 1] |= inside
        return is_open

    def _own(self, vehicle: RoadVehicle, t_s: float, *, refused: bool) -> tuple[float, ...]:
        scenario, controller = self.scenario, vehicle.controller
        lattice, length_m = scenario.lattice, scenario.road.length_m
        s_m, v_mps, _, y_m, _, _ = controller.measured
        column, lane = controller.hold_cell
        ends_m = [
            section.to_m
            for section in scenario.geometry.sections
            if section.lane == lane and section.from_m <= s_m <= section.to_m
        ]
        along_m = s_m - lattice.cell_s_m(column, t_s)
        return (
            s_m / length_m,
            max(0.0, scenario.geometry.moves_from_m - s_m) / length_m,
            (min(ends_m, default=s_m) - s_m) / length_m,
            lane / max(lattice.lanes - 1, 1),
            self._to_target(vehicle),
            (v_mps - lattice.speed_mps) / lattice.speed_mps,
            along_m / lattice.pitch_m,
            (y_m - lattice.cell_y_m(lane)) / lattice.lane_width_m,
            float(controller.motion.end_tick > round(t_s / controller.tick_s)),
            float(refused),
        )
