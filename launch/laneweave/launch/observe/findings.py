"""Findings: what is wrong with a deployment, where, since when, and what to do about it.

`RULES` is the only table of problems: `laneweave status`, `/healthz`, the live page, metrics and
health checks of containers use it. A rule looks at what an observer has received and at what should
be there (`observed`), and names the processes that it concerns. A condition becomes a finding once
it has lasted for the rule's `lasts_s`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import ClassVar, Final

from attrs import define, field, frozen

from laneweave.launch.observe.observed import (
    AGENT,
    BRIDGE,
    COORDINATOR,
    FLEET,
    UNPLANNED_S,
    Expected,
    Observed,
)
from laneweave.launch.observe.process_view import label_of
from laneweave.launch.observe.road_view import RoadView, claims_of
from laneweave.protocol.names import first_names
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.runtime.metrics import metric
from laneweave.protocol.wire.codec import VERSION
from laneweave.protocol.wire.common_settings import (
    CommonSettings,
    different_groups,
    groups_of,
)
from laneweave.protocol.wire.messages import ClosedFormation, Name
from laneweave.protocol.wire.topics import Party

ROUTER = str(Party.ROUTER)
SILENT_S = 3.0
"""Time without a message after which a bridge with a token is silent."""
STANDING_S = 2.0
"""Time for which the road may wait for agents."""
UNATTENDED_S = 2.0
"""Time for which a vehicle may be without an agent."""
MIN_UNPLANNED = 3
"""Minimum number of vehicles of the rolling operation without a plan; a few may have no path."""
CLOCK_OFF_S = 12 * 3600.0
"""Difference of clocks above which processes begin to refuse each other's messages (a day)."""
MAX_NAMED = 3
"""Maximum number of vehicles that a text names."""


@frozen
class Finding:
    """A problem of a deployment."""

    rule: str
    """Name of the rule."""
    process: str
    """Role and name of the process that it concerns, such as `coordinator c1`."""
    what: str
    for_s: float
    """For how long it has been observed [s]."""
    advice: str

    def __str__(self) -> str:
        """Return one line: what is wrong, and what to do."""
        return f"{self.what}: {self.advice}"


Found = Iterator[tuple[str, str]]
"""Process and what is wrong with it."""


@frozen
class Rule:
    """A kind of problem."""

    name: str
    find: Callable[[Observed], Found]
    """Its docstring describes the problem, also in docs/DEPLOYMENT.md."""
    advice: str
    lasts_s: float = 0.0
    """Time for which the condition must be observed."""
    until_end: bool = True
    """Whether it applies only until the road has ended."""
    of_process: bool = True
    """Whether the health check of the process alone applies it: another process may help."""


def _link_lost(observed: Observed) -> Found:
    """The connection to the router was lost."""
    if not observed.view.linked:
        yield ROUTER, "the connection to the router was lost"


def _no_bridge(observed: Observed) -> Found:
    """No bridge has its token: it never started, was killed, or has vanished."""
    view = observed.view
    if view.bridge_tokens or (not observed.expected.bridge and view.clock is None):
        return
    if view.clock is None:
        yield BRIDGE, "no bridge found"
    else:
        yield (
            BRIDGE,
            f"the bridge disappeared at {view.clock.t_s:.1f} s, before the end of its road",
        )


def _bridge_silent(observed: Observed) -> Found:
    """A bridge has its token, but hangs or was stopped."""
    for bridge in observed.view.bridge_tokens & {observed.view.bridge, *_only(observed)}:
        silent_s = observed.unheard_s(bridge)
        never = bridge not in observed.view.processes.bridges_heard_s
        if silent_s >= (1.5 if never else SILENT_S):
            yield BRIDGE, f"nothing heard from the bridge for {silent_s:.1f} s"


def _only(observed: Observed) -> Iterable[int]:
    """Return the newest bridge with a token if no bridge has been heard."""
    tokens = observed.view.bridge_tokens
    return [max(tokens)] if tokens and observed.view.bridge < 0 else []


def _several_bridges(observed: Observed) -> Found:
    """Several bridges drive roads in one realm."""
    heard = [
        bridge
        for bridge in sorted(observed.view.bridge_tokens)
        if observed.unheard_s(bridge) < SILENT_S
        and bridge in observed.view.processes.bridges_heard_s
    ]
    if len(heard) > 1:
        yield BRIDGE, f"{len(heard)} bridges are in this realm, and agents follow the newest one"


def _road_stands(observed: Observed) -> Found:
    """The road waits for agents at the entrance for 2 s or more."""
    status, clock = observed.status, observed.view.clock
    if status is None or clock is None or status.standing_s < STANDING_S:
        return
    for process, vehicles in _by_starter(observed, status.awaited).items():
        lasting = f"the road has stood at {clock.t_s:.1f} s for {status.standing_s:.0f} s"
        yield process, f"{lasting}, waiting for {_named(vehicles)}"


def _no_leader(observed: Observed) -> Found:
    """No coordinator leads."""
    candidates = observed.candidates
    if claims_of(candidates):
        return
    count = len(candidates)
    found = "one coordinator" if count == 1 else f"{count or 'no'} coordinators"
    yield COORDINATOR, f"there is no leader: {found} found"


def _several_leaders(observed: Observed) -> Found:
    """Several coordinators lead for 3 s or more: they do not accept each other's messages."""
    claims = claims_of(observed.candidates)
    if len({one.coordinator for one in claims}) > 1:
        names = " and ".join(sorted(one.coordinator for one in claims))
        for one in claims[1:]:
            yield label_of(COORDINATOR, one.coordinator), f"{names} all lead"


def _same_name(observed: Observed) -> Found:
    """Two live coordinators have the same name."""
    # The token of a killed process may persist, so only processes with heartbeats count.
    active = Counter(
        one.coordinator for one in observed.candidates if one.is_active(observed.election_s)
    )
    for name, processes in active.items():
        if processes > 1:
            what = f"{processes} coordinators have the name {name}, which must be unique"
            yield label_of(COORDINATOR, name), what


def _coordinator_missing(observed: Observed) -> Found:
    """A candidate has no token."""
    there = {one.coordinator for one in observed.candidates}
    for name in observed.expected.coordinators:
        if name not in there:
            yield label_of(COORDINATOR, name), f"no coordinator {name} found"


def _coordinator_silent(observed: Observed) -> Found:
    """A candidate has its token, but sends no heartbeats."""
    active = {one.coordinator for one in observed.candidates if one.is_active(observed.election_s)}
    for one in observed.candidates:
        if one.coordinator not in active:
            yield (
                label_of(COORDINATOR, one.coordinator),
                f"no heartbeat of coordinator {one.coordinator} for {observed.election_s:g} s",
            )


def _nothing_planned(observed: Observed) -> Found:
    """The newest formations have been closed, or vehicles able to move, for 20 s without a plan.

    A single formation without a plan may have been closed too late to sort, and a few vehicles of
    the rolling operation may have no path.
    """
    claims = claims_of(observed.candidates)
    what = _formations_without_plan(observed.view) or _vehicles_without_plan(observed)
    if what and claims:
        yield label_of(COORDINATOR, claims[0].coordinator), what


def _formations_without_plan(view: RoadView) -> str:
    """Return a text about the newest formations if they have no plan, or an empty one."""
    if view.census is None:
        return ""
    states = view.states.values()
    accepted = {state.block for state in states if state.accepted}
    unattended = {state.block for state in states if not state.attended}
    known = {state.block for state in states} - unattended
    waiting: list[ClosedFormation] = []
    for one in sorted(view.census.formations, key=lambda one: one.closed_s):
        if _in_formation(one, accepted):
            waiting = []
        elif view.t_s - one.closed_s >= UNPLANNED_S and not _in_formation(one, unattended):
            waiting += [one] if _in_formation(one, known) else []
    if not waiting:
        return ""
    have = "formation has" if len(waiting) == 1 else f"{len(waiting)} formations have"
    longest_s = view.t_s - waiting[0].closed_s
    return f"the newest closed {have} no plan, for up to {longest_s:.0f} s"


def _in_formation(formation: ClosedFormation, blocks: Collection[int]) -> bool:
    """Return whether any of some blocks are in a formation, however long it claims to be."""
    return any(formation.first_block <= block <= formation.last_block for block in blocks)


def _vehicles_without_plan(observed: Observed) -> str:
    """Return a text about vehicles of the rolling operation without a plan, or an empty one.

    Those count that entered after all that were in a ballot, and have been able to move for 20 s.
    """
    view, planned_from_m = observed.view, observed.planned_from_m
    if view.census is None or planned_from_m is None:
        return ""
    waiting: list[Name] = []
    for entry in sorted(view.census.on_lattice, key=lambda entry: entry.entered_s):
        state = view.states.get(entry.vehicle)
        if state is None:
            continue
        if state.record.promised is not None:
            waiting = []
        elif (
            state.attended
            and entry.preferred_lane not in (ANY_LANE, state.hold_cell[1])
            and state.s_m >= planned_from_m
            and view.t_s >= max(entry.entered_s, entry.ready_s) + UNPLANNED_S
        ):
            waiting.append(entry.vehicle)
    if len(waiting) < MIN_UNPLANNED:
        return ""
    named = first_names(waiting, MAX_NAMED)
    return f"{len(waiting)} vehicles off their lanes were in no plan for {UNPLANNED_S:g} s: {named}"


def _fleet_missing(observed: Observed) -> Found:
    """A shard has no process."""
    present = set(observed.shards_present().values())
    for name, shard in observed.fleets.items():
        # Fleets of the release before have no token of their own.
        attended = any(shard.contains(vehicle) for vehicle in observed.view.agent_tokens)
        if shard not in present and not attended:
            yield (
                label_of(FLEET, name),
                f"no process found for the vehicles of shard {shard.index}/{shard.count}",
            )


def _agent_missing(observed: Observed) -> Found:
    """The agent of a vehicle, asked for by name, is not there."""
    for vehicle in observed.expected.vehicles:
        if vehicle not in observed.view.agent_tokens:
            yield label_of(AGENT, vehicle), f"no agent of {vehicle} found"


def _unattended(observed: Observed) -> Found:
    """Vehicles on the road have had no agent for 2 s or more."""
    for_s = {one: time_s for one, time_s in observed.unattended().items() if time_s >= UNATTENDED_S}
    for process, vehicles in _by_starter(observed, for_s).items():
        count = len(vehicles)
        have = "vehicle has" if count == 1 else "vehicles have"
        longest = max(vehicles, key=for_s.__getitem__)
        yield process, f"{count} {have} no agent, such as {longest} for {for_s[longest]:.0f} s"


def _by_starter(observed: Observed, vehicles: Iterable[str]) -> dict[str, list[str]]:
    """Return vehicles by the process that starts their agents."""
    grouped: dict[str, list[str]] = {}
    for vehicle in vehicles:
        grouped.setdefault(_starter(observed, vehicle), []).append(vehicle)
    return grouped


def _starter(observed: Observed, vehicle: str) -> str:
    """Return the process that starts the agent of a vehicle, as far as known."""
    for name, shard in observed.fleets.items():
        if shard.contains(vehicle):
            return label_of(FLEET, name)
    return label_of(AGENT, vehicle) if vehicle in observed.expected.vehicles else "agents"


def _other_settings(observed: Observed) -> Found:
    """The settings of a process differ from those of the bridge."""
    processes = observed.view.processes
    newest = observed.view.bridge
    bridge = next((one for one in processes.tokens if one.incarnation == newest), None)
    if bridge is None:
        return
    values = processes.settings.get((bridge.role, bridge.name, bridge.incarnation))
    for one in sorted(processes.tokens, key=lambda one: one.label):
        if one.role == BRIDGE:
            continue
        groups = different_groups(one.digests, bridge.digests, one.role)
        if not groups:
            continue
        own = processes.settings.get((one.role, one.name, one.incarnation))
        what = f"settings of {', '.join(groups)} differ from those of the bridge"
        if own is not None and values is not None:
            found = CommonSettings(own.values).differences(values.values, groups_of(one.role))
            what = "; ".join(str(each) for each in found[:MAX_NAMED]) or what
        yield one.label, f"{one.label} does not act on the road: {what}"


def _clock_off(observed: Observed) -> Found:
    """A clock is off by 12 h or more; with a day, processes refuse each other's messages."""
    status = observed.status
    if status is not None and abs(status.clock_s - observed.wall_s) > CLOCK_OFF_S:
        yield BRIDGE, f"the clock of the bridge is {_off(status.clock_s - observed.wall_s)}"
    for one in sorted(observed.view.processes.tokens, key=lambda one: one.label):
        # Its start time: a process may have run for long, but not have started in the future.
        ahead_s = one.incarnation / 1e9 - observed.wall_s
        if one.role != BRIDGE and ahead_s > CLOCK_OFF_S:
            yield one.label, f"the clock of {one.label} is {_off(ahead_s)}"


def _off(ahead_s: float) -> str:
    relation = "ahead of" if ahead_s > 0 else "behind"
    return f"{abs(ahead_s) / 3600:.0f} h {relation} that of this host"


def _overlap(observed: Observed) -> Found:
    """Bodies have overlapped."""
    status = observed.status
    if status is not None and status.overlaps:
        pairs = "pair" if status.overlaps == 1 else "pairs"
        yield BRIDGE, f"bodies have overlapped: {status.overlaps} {pairs}"


def _not_recorded(observed: Observed) -> Found:
    """The disk of the bridge is full or fails."""
    status = observed.status
    if status is not None and not status.recording:
        yield BRIDGE, "the run is no longer recorded"


def _other_version(observed: Observed) -> Found:
    """A process sends messages of another version."""
    for sender, version in observed.view.processes.other_versions.items():
        yield sender, f"messages of {sender} have version {version!r:.40}, not {VERSION}"


def _named(vehicles: list[str]) -> str:
    agents = "the agent of" if len(vehicles) == 1 else "the agents of"
    return f"{agents} {first_names(vehicles, MAX_NAMED)}"


RULES: Final = (
    Rule("link-lost", _link_lost, "restart the router, or repair the network", until_end=False),
    Rule(
        "overlap",
        _overlap,
        "stop the road, and keep its folder for an examination",
        until_end=False,
        of_process=False,
    ),
    Rule(
        "other-version",
        _other_version,
        "run the same release everywhere",
        until_end=False,
    ),
    Rule("no-bridge", _no_bridge, "start the bridge", lasts_s=1.0),
    Rule("several-bridges", _several_bridges, "stop all but one", lasts_s=1.0, of_process=False),
    Rule("bridge-silent", _bridge_silent, "resume or restart it"),
    Rule("clock-off", _clock_off, "set the clock, and restart the process"),
    Rule(
        "other-settings",
        _other_settings,
        "give both processes the same file, and restart one",
        lasts_s=0.5,
    ),
    Rule("same-name", _same_name, "stop one of them", lasts_s=0.5),
    Rule("no-leader", _no_leader, "start a coordinator", lasts_s=1.0, until_end=False),
    Rule(
        "several-leaders",
        _several_leaders,
        "compare the clocks of their hosts, and restart one",
        lasts_s=3.0,
    ),
    Rule("coordinator-missing", _coordinator_missing, "start it", lasts_s=1.0),
    Rule("coordinator-silent", _coordinator_silent, "resume or restart it", lasts_s=1.0),
    Rule("fleet-missing", _fleet_missing, "start it", lasts_s=1.0),
    Rule("agent-missing", _agent_missing, "start it", lasts_s=0.5),
    Rule("road-stands", _road_stands, "start or restart the process of the agents"),
    Rule("unattended", _unattended, "start or restart the process of the agents"),
    Rule(
        "nothing-planned", _nothing_planned, "read its log; if this lasts, restart it", lasts_s=0.5
    ),
    Rule(
        "not-recorded",
        _not_recorded,
        "free space, and start a new run",
        until_end=False,
        of_process=False,
    ),
)
"""All rules, the most telling ones first: a missing bridge explains what others find."""


@frozen
class FindingsMetrics:
    """What an observer finds."""

    ABOUT: ClassVar[str] = "observer"

    findings: Mapping[str, int] = metric("Findings about the deployment", label="rule")

    @classmethod
    def of(cls, findings: Iterable[Finding]) -> FindingsMetrics:
        """Return the number of findings of each rule."""
        counts = Counter(one.rule for one in findings)
        return cls({rule.name: counts[rule.name] for rule in RULES})


@define
class Findings:
    """The findings of an observer, which looks again and again."""

    expected: Expected
    began_s: float
    """When observation began, on the clock of the observer."""
    election_s: float
    """Time without a heartbeat after which a coordinator no longer leads."""
    process: str | None = None
    """Role and name of the only process of interest; None: all."""
    _since_s: dict[tuple[str, str], float] = field(factory=dict)
    """Since when each condition has been observed without a break, by rule and process."""
    _first_s: float | None = None
    """Time of the first look."""

    def look(
        self, view: RoadView, now_s: float, wall_s: float, *, last: bool = False
    ) -> list[Finding]:
        """Look at what was received until now, and return the findings, the gravest first.

        Args:
            view: what was received.
            now_s: current time on the clock of the observer.
            wall_s: wall-clock time [s since 1970].
            last: whether this is the last look: what was so at each look counts, even if that was
                shorter than the rule asks for.
        """
        observed = Observed(view, self.expected, self.began_s, now_s, wall_s, self.election_s)
        self._first_s = now_s if self._first_s is None else self._first_s
        findings, since_s = [], dict[tuple[str, str], float]()
        for rule in RULES:
            if (rule.until_end and observed.ended) or not self._concerns(rule):
                continue
            for process, what in rule.find(observed):
                if self.process not in (None, process) and process != ROUTER:
                    continue
                key = rule.name, process
                at_s = since_s[key] = self._since_s.get(key, now_s)
                always = last and at_s <= self._first_s
                if always or now_s >= at_s + rule.lasts_s:
                    findings.append(Finding(rule.name, process, what, now_s - at_s, rule.advice))
        self._since_s = since_s
        return findings

    def _concerns(self, rule: Rule) -> bool:
        return self.process is None or rule.of_process
