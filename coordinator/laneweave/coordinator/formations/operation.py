"""The paper's operation: formations on the road, each under its own ballots."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Sequence

from attrs import evolve

from laneweave.coordinator.ballots.ballot_round import PROMISED, TIME, BallotPhase
from laneweave.coordinator.formations.formation_planner import FormationPlanner
from laneweave.coordinator.formations.leader import FormationLeader
from laneweave.coordinator.formations.roster import (
    Formation,
    Groups,
    Numbers,
    closed_formations,
    joinable,
    stage_begin_s,
)
from laneweave.coordinator.formations.stages import Stage, stages, where_overtaken, with_queues
from laneweave.coordinator.operation import LogEntry, Outcome, ToVehicle
from laneweave.coordinator.planning.response import PlanFunction
from laneweave.protocol.road_layout import NO_PARTS, TemporaryClosure, TemporaryParts
from laneweave.protocol.runtime.node import Compute, Computed
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.wire.events import FORMATIONS_JOINED, PLAN_IN_FORCE, VEHICLES_AWAITED
from laneweave.protocol.wire.messages import Ballot, Census, VehicleState

JUST_CLOSED_S = 1.0
"""Age (road time) up to which no leader can have planned for a closed formation."""
HEED_S = 1.0
"""Minimum road time between two changes of the closed parts with which formations plan."""


class FormationsOperation:
    """All formations under one leader; see `Operation`."""

    def __init__(
        self,
        scenario: Scenario,
        new_ballot: Callable[[Ballot | None], Ballot],
        new_job: Callable[[], int],
        has_watched: Callable[[float], bool],
        rng: random.Random,
        plan: PlanFunction,
        rules: RuleBook,
    ) -> None:
        """Begin without formations.

        Args:
            scenario: road, formations, timing.
            new_ballot: returns a new ballot, above the given one, if any.
            new_job: returns the id of a new computation.
            has_watched: returns whether, at a given time (node clock), this leader has handled
                events without gaps for an election timeout.
            rng: source of random pauses.
            plan: answers a request.
            rules: rules for formation leaders; tests replace some.
        """
        self.leaders: dict[int, FormationLeader] = {}
        """Leaders by the lowest block number of their formation."""
        self._scenario = scenario
        self._new_ballot = new_ballot
        self._has_watched = has_watched
        self._rng = rng
        self._rules = rules
        self._groups = Groups()
        self._parts = NO_PARTS
        """Parts of lanes that are closed for a time, will be, or are cleared for fast vehicles."""
        self._heed_nothing()
        self._planner = FormationPlanner(scenario, self._groups, self.leaders, new_job, plan)

    def forget(self) -> None:
        """Discard all formations and all joins."""
        self._groups.forget()
        self._parts = NO_PARTS
        self._heed_nothing()
        self.take_over()

    def _heed_nothing(self) -> None:
        self._heeded = NO_PARTS
        """The parts that plans take into account now; closed ones include their queues."""
        self._heeded_s = -math.inf
        """Road time of the last change of these."""
        self._heed_again_s = math.inf
        """Road time at which newer changes take effect; infinite: there are none."""

    def take_over(self) -> None:
        """Discard all formations; joined formations stay joined."""
        self.leaders.clear()
        self._planner.forget()

    def on_obstacles(self, temporary: TemporaryParts) -> None:
        """Plan with other parts of lanes that are closed or about to be closed, or cleared."""
        at_rest = (one for one in temporary.cleared if one.speed_mps == 0.0)
        soon = (TemporaryClosure(one.lane, one.from_m, one.to_m) for one in at_rest)
        moving = tuple(one for one in temporary.cleared if one.speed_mps > 0.0)
        parts = TemporaryParts((*temporary.closed, *soon), moving)
        if parts != self._parts:
            self._parts = parts
            self._groups.changed = True

    def on_clock(self, t_s: float, now_s: float) -> None:
        """Measure the ratio of road time to the node's clock."""
        self._planner.pace.on_clock(t_s, now_s)

    def on_state(self, state: VehicleState, now_s: float) -> list[LogEntry] | None:
        """Pass the state to the leader of its formation; return None if it changes nothing."""
        # Formations stay joined under any leader.
        self._groups.join((state.block, *state.record.joined))
        group = self._groups.of(state.block)
        leader = self.leaders.get(group[0])
        if leader is not None and leader.formation.numbers == group:
            before, wakeup_s = leader.phase, leader.wakeup_s
            leader.on_state(state, now_s)
            if before is BallotPhase.ISSUING and leader.phase is BallotPhase.IN_FORCE:
                data = {"formation": group[0], "closed_s": leader.formation.closed_s}
                return [LogEntry(PLAN_IN_FORCE, data)]
            if (leader.phase, leader.wakeup_s) != (before, wakeup_s):
                return []
        return [] if self._groups.changed else None

    def lead(self, census: Census, t_s: float, now_s: float, *, changed: bool) -> Iterator[Outcome]:
        """Update members, handle expired timers, request plans, send messages."""
        if self._planner.leading_since_s is None:
            self._planner.leading_since_s = t_s
        if changed or self._groups.changed or t_s >= self._heed_again_s:
            yield from self._update_members(census, t_s, now_s)
            self._groups.changed = False
        for leader in self.leaders.values():
            if leader.wakeup_s is None or leader.wakeup_s > now_s:
                continue
            leader.take(TIME, now_s)
            if leader.take(PROMISED, now_s):
                yield from self._planner.order(leader, t_s, now_s)
            for vehicle, message in leader.outgoing(now_s):
                yield ToVehicle(vehicle, message)
            if awaited := leader.pop_awaited(now_s):
                data = {"formation": leader.formation.numbers[0], "vehicles": list(awaited)}
                yield LogEntry(VEHICLES_AWAITED, data | {"phase": leader.phase.value})

    def _update_members(self, census: Census, t_s: float, now_s: float) -> Iterator[LogEntry]:
        scenario, groups = self._scenario, self._groups
        self._heed(census, t_s)
        formations = closed_formations(census, t_s, scenario, groups, self._stages_of)
        for numbers in joinable(formations, t_s, scenario):
            groups.join(numbers)
            yield LogEntry(FORMATIONS_JOINED, {"formations": list(numbers), "why": "room"})
            formations = closed_formations(census, t_s, scenario, groups, self._stages_of)
        groups.forget_departed(census, scenario.lattice.block_of)
        for number in set(self.leaders) - set(formations):
            del self.leaders[number]
        for number, formation in formations.items():
            leader = self.leaders.get(number)
            if leader is None or leader.formation.numbers != formation.numbers:
                self.leaders[number] = self._lead_formation(formation, t_s, now_s)
                self._reconsider_neighbours(formation)
            else:
                known = self._with_stage(formation, leader, t_s)
                leader.on_members(known, now_s)

    def _heed(self, census: Census, t_s: float) -> None:
        """Let changes of closed and cleared parts take effect, once in `HEED_S`.

        After each change, every formation may plan again. Queues and slow vehicles of other systems
        change parts several times in a second.
        """
        closed = with_queues(self._parts.closed, census, self._scenario)
        parts = TemporaryParts(closed, self._parts.cleared)
        if parts != self._heeded and t_s >= self._heeded_s + HEED_S:
            self._heeded, self._heeded_s = parts, t_s
        self._heed_again_s = math.inf if parts == self._heeded else self._heeded_s + HEED_S

    def _stages_of(self, numbers: Numbers) -> Sequence[Stage]:
        """Return the stages of the road for the formation with these blocks."""
        block_range, heeded = self._scenario.lattice.block_range, self._heeded
        columns = range(block_range(numbers[-1]).start, block_range(numbers[0]).stop)
        overtaken = where_overtaken(heeded.cleared, columns, self._scenario)
        return stages(self._scenario, heeded.closed, overtaken)

    def _with_stage(self, formation: Formation, leader: FormationLeader, t_s: float) -> Formation:
        """Return a formation, with the stage its leader has planned for if that plan still serves.

        Parts that are closed for a time change the stages of formations that have passed them, and
        of those that need the same lanes as before. Where it is too late for a new plan, a new
        ballot would only end the one in force.
        """
        stage, before = formation.stage, leader.formation
        goals = before.goal_lanes
        if (
            before.stage in self._stages_of(formation.numbers)
            or formation.sorts != before.sorts
            or not formation.goal_lanes.keys() <= goals.keys()
        ):
            return formation  # it has driven on to the next stage, or has new vehicles
        same_goals = formation.goal_lanes.items() <= goals.items()
        begun = all(
            stage_begin_s(formation.numbers, one, self._scenario) <= t_s
            for one in (stage, before.stage)
        )
        too_late = (
            leader.phase is BallotPhase.IN_FORCE
            and (stage.is_last or same_goals)
            and self._planner.steps_left_in(formation.numbers, stage, t_s) <= 0
        )
        if (same_goals and begun and stage.needs_same_moves(before.stage)) or too_late:
            kept = tuple(goals[name] for name in formation.roster)
            return evolve(formation, stage=before.stage, goals=kept)
        return formation

    def _reconsider_neighbours(self, formation: Formation) -> None:
        """Let the formations beside a new one plan again if they may join it and lack room."""
        if self._scenario.formation.max_joined > 1:
            beside = {formation.numbers[0] - 1, formation.numbers[-1] + 1}
            for leader in self.leaders.values():
                if not beside.isdisjoint(leader.formation.numbers):
                    leader.reconsider()

    def _lead_formation(self, formation: Formation, t_s: float, now_s: float) -> FormationLeader:
        leader = FormationLeader(
            formation,
            self._new_ballot,
            self._rng,
            self._planner.has_formed,
            resend_s=self._scenario.network.resend_s,
            rules=self._rules,
        )
        # There is no plan to adopt for a formation that has just closed while this leader watched.
        just_closed = t_s - formation.closed_s <= JUST_CLOSED_S
        leader.begin(now_s, observe=not (just_closed and self._has_watched(now_s)))
        return leader

    def finish(self, computed: Computed, t_s: float, now_s: float) -> Iterator[Compute | LogEntry]:
        """Issue the resulting plan, or try again later."""
        return self._planner.finish(computed, t_s, now_s)

    @property
    def wakeups(self) -> list[float]:
        """Times of the next timer of each leader."""
        times = (leader.wakeup_s for leader in self.leaders.values())
        return [time for time in times if time is not None]

    @property
    def in_force(self) -> int:
        """Number of formations with a plan in force."""
        return sum(leader.phase is BallotPhase.IN_FORCE for leader in self.leaders.values())
