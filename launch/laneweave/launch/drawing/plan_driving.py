"""A plan driven on the road: the vehicles' own controllers follow its relative paths.

Step k begins at k T_F. Each vehicle follows its path as an agent drives it: the reference of
`agents.driving`, its tracker, and the simulated body (`sim_bridge.bodies.plant`). All hold
their start cells at time 0. There is no noise, no other traffic and no distance control:
vehicles drive the plan with all that its conflict kinds allow.

This module needs OSQP.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from laneweave.agents.driving.reference import Reference
from laneweave.agents.driving.tracker import Tracker
from laneweave.agents.driving.trajectory import check_moves
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.vehicle.motion import cell_state, commanded_state
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Bodies, pose_of
from laneweave.sim_bridge.bodies.plant import Plant


@attrs.frozen(eq=False)
class Drive:
    """Motions of all vehicles from the start until a plan has ended.

    states: (vehicles, ticks + 1, 6): s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2] on the
        road; s is the front bumper, 0 where the rear column is at time 0; y is the body's centre,
        from the right road edge.
    slot_ticks: ticks of a step.
    overlaps: pairs of vehicles whose bodies overlapped.
    min_gap_m: shortest gap of two bodies in line; infinite: none ever were.
    """

    scenario: Scenario
    states: NDArray[np.float64]
    slot_ticks: int
    overlaps: tuple[tuple[str, str], ...]
    min_gap_m: float

    @property
    def ticks(self) -> int:
        """Duration in ticks."""
        return int(self.states.shape[1]) - 1

    def time_s(self, tick: int) -> float:
        """Return the time at a tick."""
        return tick * self.scenario.runtime.tick_s


def scenario_in_mode(scenario: Scenario, mode: int) -> Scenario:
    """Return the scenario in a relative motion mode.

    Raises:
        BadInputError: a move of this mode cannot be driven within the vehicles' limits.
    """
    scenario = attrs.evolve(scenario, formation=attrs.evolve(scenario.formation, mode=mode))
    check_moves(scenario)
    return scenario


def drive_plan(scenario: Scenario, names: Sequence[str], paths: Sequence[Sequence[Cell]]) -> Drive:
    """Drive a plan.

    Args:
        scenario: v_F, d_F, T_F, lane width, vehicles and tracking; see `scenario_in_mode`.
        names: of the vehicles.
        paths: cells of each vehicle at all time points; one time point: all hold.
    """
    slot_ticks = round(scenario.cycles_s[0] / scenario.runtime.tick_s)
    ticks = slot_ticks * (len(paths[0]) - 1)
    states = np.array([_drive_vehicle(scenario, path, slot_ticks, ticks) for path in paths])
    overlaps: set[tuple[str, str]] = set()
    min_gap_m = np.inf
    size_m = scenario.vehicle.length_m, scenario.vehicle.width_m
    for now in states.swapaxes(0, 1):
        poses = {name: pose_of(state) for name, state in zip(names, now.tolist(), strict=True)}
        bodies = Bodies(poses, *size_m)
        overlaps.update(bodies.overlapping_pairs())
        min_gap_m = min(min_gap_m, bodies.min_gaps().gap_m)
    return Drive(scenario, states, slot_ticks, tuple(sorted(overlaps)), float(min_gap_m))


def _drive_vehicle(
    scenario: Scenario, path: Sequence[Cell], slot_ticks: int, ticks: int
) -> NDArray[np.float64]:
    """Return the states of one vehicle, (ticks + 1, 6)."""
    reference, tracker = Reference.hold(scenario, path[0]), Tracker(scenario)
    start = cell_state(scenario.lattice, path[0], 0.0)
    plant = Plant(start, scenario.vehicle, scenario.runtime.tick_s)
    states, speed_mps = [start], scenario.formation.speed_mps
    for tick in range(ticks):
        step, since = divmod(tick, slot_ticks)
        if since == 0 and path[step] != path[step + 1]:
            reference = Reference.move(scenario, path[step], path[step + 1], tick)
        state = commanded_state(plant.state, plant.setpoint, scenario.vehicle, speed_mps)
        jerk_s, jerk_y = tracker.solve(state, reference.window(tick)).jerk[0].tolist()
        states.append(plant.step(jerk_s, jerk_y))
    return np.array(states)
