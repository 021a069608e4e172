"""The live road: observed state of a deployment, and the frames that show it.

A pure core that turns messages and times into frames. Every vehicle publishes its state in each
tick, or less often while it holds; until the next state arrives, its position is extrapolated from
its speed. After `UNHEARD_S` without a state, the vehicle is drawn in its cell and marked: without
new information it holds its cell, but its position is unknown. If its cell has passed a stop line,
it is drawn at that line.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from laneweave.launch.formation_columns import Formations
from laneweave.launch.observe.findings import Finding, Findings
from laneweave.launch.observe.observed import NOTHING, Expected
from laneweave.launch.observe.road_view import RoadView, claims_of
from laneweave.launch.watch.frames import (
    CLEARED_PART,
    CLOSED_PART,
    MOVING,
    OVERDUE,
    UNATTENDED,
    UNHEARD,
    EventFeed,
    Row,
    part_row,
    plan_row,
)
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.wire.messages import CAR, Ballot, CensusEntry, Name, Plan, VehicleState
from laneweave.protocol.wire.process_messages import LogEvent
from laneweave.protocol.wire.topics import (
    CENSUS,
    CLOCK,
    EVENT,
    HEARTBEAT,
    OBSTACLES,
    PLAN,
    ROAD_STATUS,
    SETTINGS,
    STATE,
)

TOPICS = (STATE, CLOCK, CENSUS, OBSTACLES, HEARTBEAT, PLAN, EVENT, ROAD_STATUS, SETTINGS)
"""Subscribed topics, most frequent first."""
UNHEARD_S = 2.0
"""Age (road time) of the newest state above which a vehicle counts as not heard from."""
STILL_S = 2.0
"""Age (wall-clock time) of the newest clock message above which the clock counts as stopped."""
MAX_PLANS = 500
MAX_COORDINATORS = 32


class LiveRoad:
    """Observed state of a deployment."""

    def __init__(self, scenario: Scenario, wall_s: float, expected: Expected = NOTHING) -> None:
        """Start at a wall-clock time, connected to the router.

        Args:
            scenario: road and network.
            wall_s: wall-clock time [s since 1970].
            expected: processes that should be there.
        """
        self.scenario = scenario
        self._watchdog = Findings(expected, wall_s, scenario.network.election_s)
        self.findings: list[Finding] = []
        """What is wrong, the gravest first, as of the newest frame."""
        self._lane_ends = LaneEnds(scenario)
        self.view = RoadView()
        self._targets: dict[Ballot, dict[Name, Cell]] = {}
        """Last cell of each moving vehicle, by plan."""
        self._events = EventFeed()
        self._plan: list[Any] | None = None
        self._status, self._since_s = "waiting", wall_s
        self._shown: tuple[int, str, int] | None = None
        """Run, status and tick of the last frame."""

    def update(self, event: object, wall_s: float) -> None:
        """Process a message, or a connection gained or lost, at a wall-clock time."""
        roads = self.view.roads
        self.view.update(event, wall_s)
        if 0 < roads < self.view.roads:
            self._plan, self._events = None, EventFeed()
            self._targets.clear()
        match event:
            case Plan():
                self._on_plan(event)
            case LogEvent():
                self._plan = plan_row(event.t_s, event.kind, event.data) or self._plan
                self._events.add(event.t_s, event.name, event.kind, event.data)
            case _:
                pass

    def _on_plan(self, plan: Plan) -> None:
        self._targets[plan.ballot] = {
            vehicle: moves[-1][2] for vehicle, moves in plan.moves.items() if moves
        }
        while len(self._targets) > MAX_PLANS:
            del self._targets[next(iter(self._targets))]

    def changed(self, wall_s: float) -> bool:
        """Return whether the run, status or tick has changed since the last frame."""
        return self._shown != self._identity(wall_s)

    def frame(self, number: int, wall_s: float) -> dict[str, Any]:
        """Return the current state as a frame; see `frames`."""
        self._shown = self._identity(wall_s)
        self._update_status(wall_s)
        view = self.view
        self.findings = self._watchdog.look(view, wall_s, wall_s)
        self._forget_departed()
        clock, formations = view.clock, self._formations()
        rows = self._rows(clock.t_s, formations) if clock is not None else ()
        findings = [[one.process, one.what, one.advice] for one in self.findings]
        return {
            "n": number,
            "run": view.roads,
            "t": round(clock.t_s, 3) if clock is not None else None,
            "w": round(wall_s, 3),
            "status": self._status,
            "since": round(self._since_s, 3),
            "findings": findings + self._lanes_missing(),
            **self._leadership(wall_s),
            "counts": [clock.demanded, clock.entered, clock.on_road, clock.left] if clock else None,
            "plan": self._plan,
            "news": self._events.rows,
            "formations": [[one.number, one.rear, one.front] for one in formations.listed],
            "joined": formations.joined(
                {state.record.joined for state in view.states.values()}, self.scenario.lattice
            ),
            "vehicles": [row.compact() for row in rows],
            **self._obstacles(clock.t_s if clock is not None else 0.0),
        }

    def _obstacles(self, t_s: float) -> dict[str, Any]:
        """Return the fields `parts` and `others`."""
        message = self.view.obstacles
        if message is None:
            return {"parts": [], "others": []}
        parts = [part_row(one.lane, one.from_m, one.to_m, CLOSED_PART) for one in message.parts]
        others = []
        for one, part in zip(message.cleared, message.temporary.cleared, strict=True):
            parts.append(part_row(one.lane, *part.at(t_s), CLEARED_PART))
            if one.length_m > 0.0:
                front_m = one.front_m + one.speed_mps * (t_s - one.at_s)
                row = [one.vehicle, one.lane, round(front_m, 2), round(one.length_m, 2)]
                others.append(row)
        return {"parts": parts, "others": others}

    def _leadership(self, wall_s: float) -> dict[str, Any]:
        """Return the fields `leader` and `candidates`, for the newest process of each name."""
        election_s = self.scenario.network.election_s
        newest = {one.coordinator: one for one in self.view.coordinators(wall_s, election_s)}
        coordinators = list(newest.values())[:MAX_COORDINATORS]
        claims = claims_of(coordinators)
        return {
            "leader": [claims[0].coordinator, claims[0].term] if claims else None,
            "candidates": [
                [one.coordinator, one.term, one.leading, (one.heard_s_ago or 0.0) >= election_s]
                for one in coordinators
            ],
        }

    def _identity(self, wall_s: float) -> tuple[int, str, int]:
        clock = self.view.clock
        return self.view.roads, self._status_at(wall_s), clock.tick if clock is not None else -1

    def _status_at(self, wall_s: float) -> str:
        view = self.view
        # The router of a run ends with it.
        if view.clock is not None and view.clock.ended:
            return "ended"
        if not view.linked:
            return "lost"
        if view.clock is None:
            return "waiting"
        return "still" if wall_s - view.clock_received_s > STILL_S else "live"

    def _update_status(self, wall_s: float) -> None:
        status = self._status_at(wall_s)
        if status != self._status:
            self._status = status
            self._since_s = self.view.clock_received_s if status == "still" else wall_s

    def _forget_departed(self) -> None:
        view = self.view
        if view.census is None:
            return
        listed = {entry.vehicle for entry in view.census.on_road}
        view.states = {
            name: state
            for name, state in view.states.items()
            # A vehicle with a state newer than the census may have entered after the census.
            if name in listed or state.t_s > view.census.t_s
        }

    def _formations(self) -> Formations:
        """Return the closed formations on the road."""
        census = self.view.census
        if census is None:
            return Formations()
        return Formations.of_census(census.formations, self.scenario.lattice)

    def _rows(self, t_s: float, formations: Formations) -> Iterator[Row]:
        for name, (entry, state) in self._vehicles().items():
            if self._has_lanes_of(entry, state):
                yield self._row(name, t_s, entry, state, formations)

    def _vehicles(self) -> dict[Name, tuple[CensusEntry | None, VehicleState | None]]:
        """Return what is known about each vehicle: from the census, and from itself."""
        census, states = self.view.census, self.view.states
        listed = {entry.vehicle: entry for entry in census.on_road} if census is not None else {}
        return {name: (listed.get(name), states.get(name)) for name in {**listed, **states}}

    def _has_lanes_of(self, entry: CensusEntry | None, state: VehicleState | None) -> bool:
        """Return whether the page's scenario has the lanes of a vehicle."""
        cells = [entry.cell] if entry is not None else []
        if state is not None:
            cells += [state.hold_cell, *state.record.owned]
        return all(0 <= lane < self.scenario.road.lanes for _, lane in cells)

    def _lanes_missing(self) -> list[list[str]]:
        """Return a row of the field `findings` if the scenario lacks the lanes of vehicles."""
        hidden = sum(not self._has_lanes_of(*known) for known in self._vehicles().values())
        if not hidden:
            return []
        lanes = self.scenario.road.lanes
        what = f"the page shows {lanes} lanes; vehicles in other lanes, not shown: {hidden}"
        return [["watch", what, "start it with the road's scenario: --config FILE"]]

    def _row(
        self,
        name: Name,
        t_s: float,
        entry: CensusEntry | None,
        state: VehicleState | None,
        formations: Formations,
    ) -> Row:
        lattice, owner = self.scenario.lattice, None
        if entry is not None:
            owner = formations.at(entry.cell[0])
        elif state is not None:
            owner = formations.at(lattice.block_range(state.block).start)
        formation = -1 if owner is None else owner.number
        preferred = entry.preferred_lane if entry is not None else ANY_LANE
        vehicle_type = entry.vehicle_type if entry is not None else CAR
        if state is not None and abs(t_s - state.t_s) <= UNHEARD_S:
            flags = MOVING * state.moving | UNATTENDED * (not state.attended)
            return Row(
                name=name,
                s_m=state.s_m + (t_s - state.t_s) * state.speed_mps,
                y_m=state.y_m,
                speed_mps=state.speed_mps,
                preferred_lane=preferred,
                formation=formation,
                hold=None if self._lane_ends.has_passed(state.hold_cell, t_s) else state.hold_cell,
                target=self._target_of(state),
                flags=flags | OVERDUE * state.overdue,
                owned=[cell for cell in state.record.owned if cell != state.hold_cell],
                vehicle_type=vehicle_type,
            )
        cell = state.hold_cell if state is not None else entry.cell if entry is not None else (0, 0)
        s_m, off_lattice = lattice.cell_s_m(cell[0], t_s), self._lane_ends.has_passed(cell, t_s)
        if off_lattice and (end := self._lane_ends.ahead(cell[1], s_m)) is not None:
            s_m = end.line_m
        return Row(
            name=name,
            s_m=s_m,
            y_m=lattice.cell_y_m(cell[1]),
            speed_mps=lattice.speed_mps,
            preferred_lane=preferred,
            formation=formation,
            hold=None if off_lattice else cell,
            target=None,
            flags=UNHEARD,
            vehicle_type=vehicle_type,
        )

    def _target_of(self, state: VehicleState) -> Cell | None:
        """Return the last cell of the plan that a vehicle executes, or None if it is unknown."""
        if state.record.promised is None or not state.accepted or state.done:
            return None
        return self._targets.get(state.record.promised, {}).get(state.vehicle)
