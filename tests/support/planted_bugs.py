"""Planted bugs: each breaks one rule of the protocol, to show that the tests would notice.

Most replace a guard or an action in a rule book; a few change a row of the table, or something
outside the books (`plant`). Each makes a scenario of tests/scenarios fail. docs/SAFETY.md lists
them and what else catches them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import pytest
from attrs import field, frozen

from laneweave.coordinator.ballots import ballot_round as ballot
from laneweave.coordinator.formations import leader
from laneweave.coordinator.rolling import transfer
from laneweave.launch.fault_search.coverage import Rules
from laneweave.protocol.state_machine import Function, RuleBook, Transition
from laneweave.protocol.vehicle import execution_rules as vehicle
from support import broken_cell_ownership as rolling
from support import broken_rules as broken
from support.rule_books import replacing

ROWS_OF_OTHERS = {
    "L1": "election: coordinator.election",
    "L3": "ballots: CoordinatorCore",
    "census": "which formations are closed: roadside, coordinator.formations.roster",
    "joining": "which formations are joined: coordinator.formations.roster",
    "charge": "who acts for a vehicle: AgentCore, MotionController",
    "caretaker": "who acts for a vehicle without agent: sim_bridge.caretaker",
    "ownership": "which vehicle owns a cell (rolling operation): MotionController, plans",
    "transfer": "how a leader transfers cells: coordinator.rolling.transfer",
}
"""Rules that are not, or not only, in the rule books, and where they are."""


def unchanged(_: pytest.MonkeyPatch) -> None:
    """Change nothing outside the rule books."""


@frozen(eq=False)
class Bug:
    """One broken rule."""

    name: str
    rule: str
    """Of docs/PROTOCOL.md, or one of `ROWS_OF_OTHERS`."""
    text: str
    """What is broken."""
    scenario: str = ""
    """A scenario of tests/scenarios that it makes fail; empty: none is written for it."""
    collides: bool = True
    """That scenario ends with two vehicles in one cell (in the rolling operation also: with two
    owners of one, or with a body in a cell that is not its own)."""
    replaced: Mapping[Function, Function] = field(factory=dict)
    """Guards and actions of a vehicle or a leader, and their replacements."""
    vehicle_row: Callable[[Transition], Transition] | None = None
    """Changes rows of a vehicle's table."""
    plant: Callable[[pytest.MonkeyPatch], None] = unchanged
    """Changes what is in no rule book."""

    @property
    def vehicle_rules(self) -> RuleBook:
        """A vehicle's rules with this bug."""
        book = self._broken(vehicle.VEHICLE_RULES)
        return book if self.vehicle_row is None else RuleBook(map(self.vehicle_row, book.table))

    @property
    def leader_rules(self) -> RuleBook:
        """A leader's rules with this bug."""
        return self._broken(leader.LEADER_RULES)

    @property
    def rules(self) -> Rules:
        """All rule books with this bug, for the fault search."""
        return Rules(self.vehicle_rules, self.leader_rules, self._broken(transfer.TRANSFER_RULES))

    def _broken(self, book: RuleBook) -> RuleBook:
        used = book.functions
        return replacing(book, {rule: bug for rule, bug in self.replaced.items() if rule in used})


BUGS: tuple[Bug, ...] = (
    # --- V2: promises
    Bug("lower-ballot-promised", "V2", "A ballot below the promised one is promised as well.",
        "late_duplicate_plan", collides=False, replaced={vehicle.is_above_promise: broken.always}),
    Bug("promise-keeps-count", "V2", "A promise does not reset the count of completed moves.",
        "promise_resets_the_count", replaced={vehicle.drop_plan: broken.keep_count}),
    Bug("promise-keeps-plan", "V2", "A promise does not drop the old plan.",
        "prepare_while_moving", replaced={vehicle.drop_plan: broken.skip}),
    Bug("promise-keeps-heard", "V2", "Progress reported under the old plan counts for the new one.",
        "promise_discards_what_was_heard", replaced={vehicle.forget_progress: broken.skip}),
    Bug("joining-not-asked", "V2", "A promise does not request storage of its blocks as joined.",
        "joint_ballot", collides=False, replaced={vehicle.promise: broken.promise_without_joining}),
    # --- V3: acceptance
    Bug("no-promise-check", "V3", "Any plan that names the vehicle is accepted at any time.",
        "plan_of_a_resumed_leader", collides=False,
        replaced={vehicle.is_promised_ballot: broken.always, vehicle.take_plan: broken.accept_anew},
        vehicle_row=broken.plan_in_any_phase),
    Bug("acceptance-not-noted", "V3", "An acceptance counts before the controller has stored it.",
        "replaced_agent_takes_a_newer_plan",
        replaced={vehicle.is_stored: broken.always}, plant=broken.note_by_itself),
    Bug("lower-ballot-plan-accepted", "V3", "A plan of a lower ballot than promised is accepted.",
        "plan_of_a_lower_ballot", collides=False,  # acceptances name their ballot
        replaced={vehicle.is_promised_ballot: broken.always}),
    Bug("plan-taken-twice", "V3", "A repeated PLAN restarts the plan.",
        "plan_repeated", replaced={vehicle.take_plan: broken.accept_anew},
        vehicle_row=broken.plan_in_any_phase),
    Bug("incarnation-not-checked", "V3", "A plan for an earlier process is accepted.",
        "plan_for_an_earlier_process", replaced={vehicle.names_own_incarnation: broken.always}),
    Bug("start-cell-not-checked", "V3", "A plan with a wrong start cell is accepted.",
        "planner_has_a_wrong_cell", replaced={vehicle.starts_in_hold_cell: broken.always}),
    Bug("plan-not-checked", "V3", "A plan in which two vehicles collide is accepted.",
        "planner_lets_two_meet", replaced={vehicle.is_executable: broken.always}),
    Bug("territory-not-checked", "V3", "A plan beyond the blocks of its formations is accepted.",
        "planner_leaves_its_block", replaced={vehicle.stays_in_its_blocks: broken.always}),
    Bug("joined-not-checked", "V3", "A plan for formations that were not joined is accepted.",
        "planner_claims_another_block", replaced={vehicle.has_joined: broken.always}),
    Bug("part-of-blocks-accepted", "V3", "A plan for some of the joined blocks is accepted.",
        "planner_leaves_a_block_out",
        replaced={vehicle.has_joined: broken.plans_for_some_of_its_blocks}),
    # --- V4, V5: news and the start gate
    Bug("no-gate", "V5", "The gate opens without waiting for other members.",
        "start_gate_guards_a_moving_vehicle", replaced={vehicle.all_are_ready: broken.always}),
    Bug("gate-minus-one", "V5", "The gate opens when all other members but one are ready.",
        "gate_minus_one", replaced={vehicle.all_are_ready: broken.all_but_one_are_ready}),
    Bug("gate-on-promise", "V4", "The promises of all others open the gate.",
        "gate_on_promise",
        replaced={
            vehicle.is_of_same_plan: broken.promised_my_ballot,
            vehicle.record_progress: broken.hear_any_state,
        }),
    Bug("ready-while-moving", "V4", "A vehicle that has accepted counts as ready while it moves.",
        "prepare_while_moving", plant=broken.ready_with_plan),
    Bug("one-acceptance-opens-the-gate", "V4", "Any other member's acceptance opens the gate.",
        "gate_minus_one", replaced={vehicle.reports_open_gate: broken.always}),
    Bug("go-of-another-ballot", "V4", "An open gate in another ballot opens this one.",
        "gate_is_open_for_all", replaced={vehicle.is_of_same_plan: broken.accepted_mine_or_goes}),
    Bug("release-on-any-ballot", "V4", "Moves completed in any plan count for this one.",
        "newer_ballot_releases_nothing",
        replaced={vehicle.is_of_same_plan: broken.accepted_anything}),
    Bug("release-on-a-newer-ballot", "V4", "Moves completed in a newer plan count for this one.",
        "newer_ballot_releases_nothing",
        replaced={vehicle.is_of_same_plan: broken.accepted_mine_or_newer}),
    Bug("move-under-way-counts", "V4", "A move that has begun counts as completed.",
        "dependency", replaced={vehicle.record_progress: broken.hear_moves_under_way}),
    # --- V6, V7: moves
    Bug("timetable", "V6", "The clock alone releases moves.",
        "dependency", replaced={vehicle.is_released: broken.always}),
    Bug("lease", "V6", "A move is released when it has been due for a long time.",
        "lease", replaced={vehicle.is_released: broken.is_released_after_a_while}),
    Bug("need-minus-one", "V6", "A move waits for one completed move fewer than required.",
        "dependency", plant=broken.need_one_less),
    Bug("corners-forgotten", "V6", "The corner cells of oblique moves are not reserved.",
        "corner", plant=broken.forget_corners),
    Bug("start-while-moving", "V6", "A move begins before the previous motion has ended.",
        "one_motion_at_a_time", replaced={vehicle.is_holding: broken.always}),
    Bug("no-pacing", "V6", "Moves begin before their time.",
        "paced_by_the_clock", collides=False, replaced={vehicle.move_is_due: broken.always}),
    Bug("counted-at-the-start", "V7", "A move is counted when it begins.",
        "dependency",
        replaced={vehicle.start_move: broken.start_and_count, vehicle.count_move: broken.skip}),
    Bug("old-motion-counts", "V7", "A motion of an older plan is counted in the new one.",
        "motion_of_an_old_plan", replaced={vehicle.moved_in_plan: broken.always}),
    Bug("body-out-of-its-cell-holds", "V8",
        "A vehicle that has fallen back counts as holding its cell.",
        "body_out_of_its_cell", replaced={vehicle.leave_cell: broken.skip}),
    # --- a leader
    Bug("heartbeat-revives-dead-candidate", "L1", "A heartbeat in flight revives a dead candidate.",
        "late_heartbeat_of_a_dead_candidate", collides=False, plant=broken.revive),
    Bug("disconnected-candidate-leads", "L1", "A disconnected candidate considers all others dead.",
        "own_connection_lost", collides=False, plant=broken.ignore_link_loss),
    Bug("adoption-without-all-members", "L2", "A plan is adopted before all members have reported.",
        "leader_killed_after_half_of_the_plans", collides=False,
        replaced={
            leader.all_have_reported: broken.always,
            leader.one_plan_is_in_force: broken.heard_have_accepted,
        }),
    Bug("mixed-ballots-adopted", "L2", "A plan is adopted although some members accepted another.",
        "mixed_ballots", collides=False,
        replaced={leader.one_plan_is_in_force: broken.all_have_accepted}),
    Bug("overdue-plan-adopted", "L2", "A plan that stalls is adopted.",
        "overdue_is_not_adopted", collides=False,
        replaced={leader.one_plan_is_in_force: broken.one_ballot}),
    Bug("adoption-interrupts", "L2", "Adopted promises are forgotten, so all members seem new.",
        "adoption", collides=False, replaced={leader.adopt: broken.adopt_the_ballot_only}),
    Bug("ballot-reused-after-restart", "L3",
        "Ballots do not distinguish processes of the same name.",
        "leader_restarts", plant=broken.forget_incarnation),
    Bug("second-plan-under-one-ballot", "L3",
        "The leader prepares and plans again under the same ballot.",
        "one_plan_per_ballot", replaced={leader.prepare: broken.prepare_the_same}),
    Bug("old-states-are-news", "L4", "A late state of an earlier process counts as a promise.",
        "late_promise_of_an_earlier_process", collides=False, plant=broken.take_old_states),
    Bug("promise-of-any-ballot", "L4", "A promise of another ballot is counted for this one.",
        "leader_restarts", collides=False, replaced={ballot.is_promise: broken.promised_something}),
    Bug("joined-ignored", "L4", "A promise counts regardless of the joined blocks.",
        "joint_ballot_needs_all", collides=False, replaced={leader.has_joined: broken.always}),
    Bug("part-of-blocks-planned", "L4", "Leaders plan for some of the joined blocks; all accept.",
        "joint_ballot_needs_all",
        replaced={
            leader.has_joined: broken.always,
            vehicle.has_joined: broken.plans_for_some_of_its_blocks,
        },
        plant=broken.join_nothing),
    Bug("void-promise-counted", "L4", "The promise of a process that has ended is kept.",
        "promise_forgotten", collides=False, replaced={leader.void_promise: broken.skip}),
    Bug("promise-without-cell", "L4", "The leader plans from cells other than the promised ones.",
        "late_duplicate_plan", collides=False,
        replaced={ballot.count_promise: broken.count_entry_cell}),
    Bug("roster-of-heard-members", "L5", "The roster contains only members that have reported.",
        "member_not_heard", plant=broken.roster_of_heard),
    Bug("early-exclusion", "L5", "The promises of a majority are enough.",
        "silent_vehicle", plant=broken.roster_of_majority),
    Bug("promises-not-awaited", "L5", "The leader plans only for the first members that promise.",
        "silent_vehicle",
        replaced={ballot.all_have_promised: broken.any_has_promised},
        plant=broken.roster_of_promised),
    Bug("prepared-again-after-failure", "L5", "After failed planning a new ballot is prepared.",
        "planning_fails", collides=False, replaced={leader.keep_ballot: broken.prepare_anew}),
    Bug("failed-planning-repeated-at-once", "L5", "Failed planning is repeated without a pause.",
        "planning_fails", collides=False, replaced={ballot.may_plan: broken.always}),
    Bug("promise-taken-for-acceptance", "L6", "A promise counts as an acceptance.",
        "plan_lost_for_one", collides=False, replaced={ballot.is_acceptance: broken.promised_b}),
    Bug("one-acceptance-is-enough", "L6",
        "The leader stops sending PLAN after the first acceptance.",
        "plan_lost_for_one", collides=False, replaced={ballot.is_last: broken.always}),
    Bug("outbid-not-noticed", "L7", "A leader that has been outbid continues.",
        "two_leaders", collides=False, replaced={ballot.has_higher_promise: broken.never}),
    Bug("restart-not-noticed", "L8", "The leader ignores that a vehicle's process has changed.",
        "restart_hidden_by_a_duplicate", collides=False,
        replaced={ballot.restarted: broken.shows_another_ballot}),
    Bug("refused-plan-sent-for-ever", "L8", "A plan that no vehicle accepts is never given up.",
        "planner_lets_two_meet", collides=False,
        replaced={leader.time_is_up: broken.time_is_up_unless_issuing}),
    Bug("stall-not-noticed", "L8", "A stalled plan is never replaced.",
        "adopted_plan_stalls", collides=False, replaced={leader.stalls: broken.never}),
    Bug("wrong-lane-not-noticed", "L8",
        "A vehicle off its lane after an old plan gets no new plan.",
        "adopted_for_other_targets", collides=False, replaced={leader.is_off_lane: broken.never}),
    Bug("new-targets-not-noticed", "L8", "New members or targets do not cause a new ballot.",
        "new_member", collides=False, replaced={leader.has_new_targets: broken.never}),
    # --- outside the books
    Bug("planned-before-closed", "census", "A formation is planned while vehicles may still enter.",
        "formation_closes", plant=broken.close_at_once),
    Bug("closed-before-all-entered", "census", "A formation closes while vehicles may still enter.",
        "formation_closes", plant=broken.close_early),
    Bug("joined-not-learned", "joining", "A leader does not learn which formations are joined.",
        "joint_ballot_is_learned", collides=False, plant=broken.join_nothing),
    Bug("superseded-command-played", "charge",
        "The controller executes the commands of any process.",
        "superseded_agent", plant=broken.play_any_command),
    Bug("promises-before-in-charge", "charge", "An agent promises before it is in charge.",
        "agent_that_is_not_in_charge", collides=False, plant=broken.always_in_charge),
    Bug("resumed-agent-continues", "charge", "A resumed agent acts as if it were still in charge.",
        "agent_that_hung", collides=False, plant=broken.keep_incarnation),
    Bug("caretaker-accepts-moves", "caretaker", "The caretaker accepts moves that it never makes.",
        "caretaker_never_moves", collides=False, plant=broken.accept_moves),
    Bug("caretaker-forgets-motion", "caretaker",
        "A moving vehicle counts as holding its target cell.",
        "caretaker_of_a_moving_vehicle", plant=broken.never_moving),
    # --- the rolling operation
    Bug("ownership-not-checked", "V3", "A plan that claims another vehicle's cell is accepted.",
        "rolling_false_claim", replaced={vehicle.transfers_only_owned_cells: broken.always}),
    Bug("ownership-not-taken", "V5", "A vehicle opens its gate, but not its cell transfer.",
        "rolling_cell_transfer", collides=False, replaced={vehicle.open_transfer: broken.skip}),
    Bug("moves-outside-owned-cells", "V5",
        "The same, and the controller accepts cells that are not owned.",
        "rolling_cell_transfer",
        replaced={vehicle.open_transfer: broken.skip}, plant=rolling.obey),
    Bug("ownership-without-gate", "ownership",
        "A vehicle owns its new cells as soon as it accepts.",
        "rolling_gate", plant=rolling.own_at_once),
    Bug("transfer-after-promise", "ownership", "An old transfer is stored after a higher promise.",
        "rolling_late_command", plant=rolling.note_any_transfer),
    Bug("promise-lost-with-process", "ownership",
        "A new process may promise a lower ballot than the last one.",
        "rolling_agent_restarts", collides=False, plant=rolling.forget_promise),
    Bug("ownership-lost-with-process", "ownership", "The owned cells are lost with the agent.",
        "rolling_agent_restarts", collides=False, plant=rolling.forget_owned_cells),
    Bug("promise-not-noted", "transfer", "A promise counts before the controller has stored it.",
        "rolling_promise_not_noted", collides=False, plant=rolling.show_owned_cells_at_once),
    Bug("closed-transfers-ignored", "transfer", "Leaders treat every closed transfer as cancelled.",
        "rolling_cell_passed_on", plant=rolling.cancel_closed_transfers),
    Bug("common-promise-cancels-transfers", "transfer",
        "A common newer promise cancels closed transfers.",
        "rolling_cell_passed_on", plant=rolling.cancel_on_common_promise),
    Bug("body-left-out", "transfer", "A moving vehicle does not need the cell that it leaves.",
        "rolling_under_way", plant=rolling.forget_motion),
    Bug("owner-left-out", "transfer", "A cell is taken from an owner that is not in the roster.",
        "rolling_owner_left_out", replaced={vehicle.transfers_only_owned_cells: broken.always},
        plant=rolling.skip_ownership_checks),
    Bug("cell-kept-by-both", "transfer", "A vehicle that gives a cell away also keeps it.",
        "rolling_cell_transfer", replaced={vehicle.transfers_only_owned_cells: broken.always},
        plant=rolling.keep_what_is_given),
)  # fmt: skip

NOT_A_SAFETY_MATTER: Mapping[Function, str] = {
    vehicle.is_in_roster: "a PREPARE is sent to its roster only; to promise more means to hold",
    vehicle.publish_state: "what is not shown now is shown at the next tick",
    vehicle.is_moving: "a motion that is not under way cannot end",
    vehicle.has_next_move: "without a next move there is nothing to begin",
    vehicle.rest: "a vehicle that never rests never moves again",
    vehicle.drives_its_moves: "the planner offers no other move; too weak a body lags, and brakes",
    vehicle.both_lanes_are_open: "it delays moves that are planned for later in a slot",
    vehicle.ends_in_time: "a move that begins late is stopped at the stop line of its lane",
    leader.observe_members: "how long a leader listens is a matter of progress",
    leader.back_off: "the length of a pause is a matter of progress",
    ballot.had_promised: "it only guards `void_promise` and `record_restart`",
    ballot.order_plan: "the planning itself is the leader's work; vehicles check the plan",
    ballot.issue: "it only sends the plan",
    ballot.count_acceptance: "it only saves messages",
    transfer.reports_owned_cells: "a plan that transfers no cells is refused by all vehicles",
    transfer.record_outbid: "it only says why the ballot was given up",
    transfer.record_restart: "likewise",
    transfer.record_reason: "likewise",
}
"""Guards and actions that no bug is planted in, and why."""
