"""The fault specification of a run: the format of fault files (reference: docs/FAULTS.md).

A file has any number of tables `[[messages]]`, `[[kill]]`, `[[pause]]`, `[[partition]]`,
`[[link]]` and `[[breakdown]]`. Faults begin at a road time; durations are in wall-clock time, those
of breakdowns in road time. The package contains preset files, which are selected by name.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from importlib.resources import as_file, files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, ClassVar

import attrs
from attrs import field, frozen
from attrs.validators import optional

from laneweave.protocol.config.source_files import SourceFile, read_toml_source
from laneweave.protocol.errors import (
    NO_VALUE,
    BadInputError,
    Described,
    raise_all,
    unknown_name,
)
from laneweave.protocol.field_validators import one_of, within
from laneweave.protocol.names import span_of
from laneweave.protocol.road_layout import LONGEST_ROAD_M
from laneweave.protocol.runtime.message_faults import SENDERS, MessageRule
from laneweave.protocol.structuring import NumberOrRange, structure

LEADER, COORDINATOR, ROUTER, AGENT = "leader", "coordinator", "router", "agent"
BRIDGE = "bridge"
SENDER_OF_GROUP = dict(zip(("vehicles", "coordinators", "bridge"), SENDERS, strict=True))
"""Groups that a partition may separate, with their sender names in message rules."""
GROUPS = tuple(SENDER_OF_GROUP)
OTHERS = "others"
ALL = "all"
AUTO, NAMESPACES, MESSAGES = "auto", "namespaces", "messages"
FaultSource = Mapping[str, Any] | Path | str | None
"""Faults: tables, the path of a file, the name of a preset, or none."""
MAX_BURST_LOSS = 0.5
MIN_LOSS = 0.001
MAX_PACKET_DELAY_S = 10.0
MAX_S = 1e6
MAX_TIMES = 10_000
MIN_EVERY_S = 0.1
"""Minimum of `every_s`: due faults are applied about ten times per second."""


def _range(_: object, attribute: attrs.Attribute[Any], value: tuple[float, float]) -> None:
    first, last = value
    if not 0.0 <= first <= last <= MAX_S:
        raise BadInputError(attribute.name, value, f"[a, b] with 0 <= a <= b <= {MAX_S:g}")


def _duration(_: object, attribute: attrs.Attribute[Any], value: NumberOrRange) -> None:
    first, last = value if isinstance(value, tuple) else (value, value)
    if not 0.0 < first <= last <= 600.0:
        raise BadInputError(
            attribute.name, value, "a number in (0, 600], or [a, b] with 0 < a <= b <= 600"
        )


def _loss(_: object, attribute: attrs.Attribute[Any], value: float) -> None:
    if value != 0.0 and not MIN_LOSS <= value <= 1.0:
        raise BadInputError(attribute.name, value, f"0, or [{MIN_LOSS:g}, 1]")


@frozen(kw_only=True)
class RoleFault:
    """Fields that kills and pauses share: target and times.

    Raises:
        BadInputError: a value is not allowed, or values contradict each other.
    """

    verb: ClassVar[str]
    """What happened to the target, as a past participle."""

    target: str = LEADER
    """`leader`, `router`, `bridge` (kills only), `coordinator` (any), `agent` (any on the road), or
    the name of a coordinator or a vehicle."""
    count: int = field(default=1, validator=within(1, 10_000))
    """Number of different targets; above 1 only for `agent` and `coordinator`."""
    at_s: float | None = field(default=None, validator=optional(within(0.0, MAX_S)))
    """Road time; this or `between_s` is required."""
    between_s: tuple[float, float] | None = field(default=None, validator=optional(_range))
    """Range of road times from which a time is drawn for each target and repetition."""
    every_s: float | None = field(default=None, validator=optional(within(MIN_EVERY_S, MAX_S)))
    """Road time between repetitions; only with `at_s`."""
    times: int | None = field(default=None, validator=optional(within(1, MAX_TIMES)))
    """Number of repetitions; None: one, or unlimited with `every_s`."""

    def __attrs_post_init__(self) -> None:
        """Check that the fields do not contradict each other."""
        if self.at_s is None and self.between_s is None:
            raise BadInputError("at_s", NO_VALUE, "a road time, or between_s instead")
        if self.at_s is not None and self.between_s is not None:
            raise BadInputError("between_s", self.between_s, "nothing if at_s is given")
        if self.every_s is not None and self.at_s is None:
            raise BadInputError("every_s", self.every_s, "only with at_s")
        if self.times is not None and self.at_s is not None and self.every_s is None:
            raise BadInputError("times", self.times, "only with every_s or between_s")
        if self.count * (self.times or 1) > MAX_TIMES:
            raise BadInputError("times", self.times, f"count * times of at most {MAX_TIMES}")
        if self.count > 1 and self.target not in (AGENT, COORDINATOR):
            raise BadInputError("count", self.count, f"1, or a target {AGENT} or {COORDINATOR}")

    @property
    def from_s(self) -> float:
        """Road time of the first event, or its lower bound."""
        return self.at_s if self.at_s is not None else (self.between_s or (0.0, 0.0))[0]


@frozen(kw_only=True)
class Kill(RoleFault):
    """Kill roles with SIGKILL, and optionally restart them with empty memory."""

    verb = "killed"

    restart_after_s: float | None = field(default=None, validator=optional(within(0.0, 600.0)))
    """Wall-clock seconds until the restart; None: no restart."""
    restart_share: float = field(default=1.0, validator=within(0.0, 1.0))
    """Share of killed roles that are restarted."""

    def __attrs_post_init__(self) -> None:
        """Check that the fields do not contradict each other."""
        super().__attrs_post_init__()
        if self.restart_share < 1.0 and self.restart_after_s is None:
            raise BadInputError("restart_share", self.restart_share, "1 without restart_after_s")
        if self.target == BRIDGE:
            for name in ("restart_after_s", "every_s", "times"):
                value = getattr(self, name)
                if value is not None:
                    allowed = f"none with target {BRIDGE}: another bridge drives another road"
                    raise BadInputError(name, value, allowed)


@frozen(kw_only=True)
class Pause(RoleFault):
    """Pause roles with SIGSTOP, and resume them later with SIGCONT and stale state."""

    verb = "paused"

    for_s: NumberOrRange = field(validator=_duration)
    """Wall-clock seconds, or a range from which they are drawn for each pause."""

    def __attrs_post_init__(self) -> None:
        """Check that the fields do not contradict each other."""
        super().__attrs_post_init__()
        if self.target == BRIDGE:
            allowed = "any other target: a paused bridge stops the road and its clock"
            raise BadInputError("target", BRIDGE, allowed)


@frozen(kw_only=True)
class TimedFault:
    """Fields of faults that are in force for a period of road time.

    Raises:
        BadInputError: a value is not allowed, or values contradict each other.
    """

    from_s: float = field(default=0.0, validator=within(0.0, MAX_S))
    until_s: float | None = field(default=None, validator=optional(within(0.0, MAX_S)))
    """End (road time); None: the end of the run."""

    def __attrs_post_init__(self) -> None:
        """Check that the fields do not contradict each other."""
        if self.until_s is not None and self.until_s <= self.from_s:
            raise BadInputError("until_s", self.until_s, f"more than from_s, {self.from_s:g}")

    def holds(self, road_s: float) -> bool:
        """Return whether the fault is in force at a road time."""
        return self.from_s <= road_s and (self.until_s is None or road_s < self.until_s)


@frozen(kw_only=True)
class Partition(TimedFault):
    """Separate one group from all others, or two groups from each other.

    Raises:
        BadInputError: a value is not allowed, or values contradict each other.
    """

    between: tuple[str, str]
    """Two groups, or a group and `others` (all processes outside the group)."""
    method: str = field(default=AUTO, validator=one_of(AUTO, NAMESPACES, MESSAGES))

    def __attrs_post_init__(self) -> None:
        """Check that the fields do not contradict each other."""
        first, second = self.between
        if first == second or first not in GROUPS or second not in (*GROUPS, OTHERS):
            allowed = f"two of {', '.join(GROUPS)}, or one of them and {OTHERS}"
            raise BadInputError("between", list(self.between), allowed)
        super().__attrs_post_init__()
        if self.method == NAMESPACES and second != OTHERS:
            # All messages pass through one router, so a link separates a group from all others.
            raise BadInputError("method", NAMESPACES, f"{MESSAGES}, or {OTHERS} in between")

    @property
    def label(self) -> str:
        """The two sides in words."""
        return " and ".join(self.between)

    @property
    def may_use_links(self) -> bool:
        """Whether taking a network link down can implement this partition."""
        return self.between[1] == OTHERS and self.method != MESSAGES

    def message_rules(self) -> Iterator[MessageRule]:
        """Yield rules that drop all messages between the two sides."""
        first, second = self.between
        others = [group for group in GROUPS if group != first] if second == OTHERS else [second]
        one = SENDER_OF_GROUP[first]
        for other in (SENDER_OF_GROUP[group] for group in others):
            for sender, receiver in ((one, other), (other, one)):
                yield MessageRule(
                    loss=1.0,
                    from_s=self.from_s,
                    until_s=self.until_s,
                    sender=sender,
                    receiver=receiver,
                )


@frozen(kw_only=True)
class LinkFault(TimedFault):
    """Lose and delay packets on links between groups and the router."""

    of: str = field(default=ALL, validator=one_of(*GROUPS, ALL))
    """Group whose link is affected, in both directions; `all`: every group's."""
    loss: float = field(default=0.0, validator=_loss)
    """Share of packets that are lost in each direction; at most 0.5 with bursts."""
    burst: int = field(default=1, validator=within(1, 1000))
    """Number of successive packets lost together; 1: each packet is lost independently."""
    delay_s: float = field(default=0.0, validator=within(0.0, MAX_PACKET_DELAY_S))
    """Wall-clock delay of each packet in each direction."""
    jitter_s: float = field(default=0.0, validator=within(0.0, MAX_PACKET_DELAY_S))
    """Maximum of an additional, uniformly distributed delay of each packet; reorders packets."""

    def __attrs_post_init__(self) -> None:
        """Check that the fields do not contradict each other."""
        super().__attrs_post_init__()
        if not self.loss and not self.delays:
            raise BadInputError("loss", NO_VALUE, "a share of packets, or delay_s or jitter_s")
        if self.burst > 1 and not self.loss:
            raise BadInputError("burst", self.burst, "1 without loss")
        if self.burst > 1 and self.loss > MAX_BURST_LOSS:
            raise BadInputError("burst", self.burst, f"1 if loss is above {MAX_BURST_LOSS:g}")

    @property
    def label(self) -> str:
        """Group whose link is affected."""
        return self.of

    @property
    def delays(self) -> bool:
        """Whether packets are delayed."""
        return self.delay_s > 0.0 or self.jitter_s > 0.0

    @property
    def groups(self) -> tuple[str, ...]:
        """Groups whose links are affected."""
        return GROUPS if self.of == ALL else (self.of,)


@frozen(kw_only=True)
class BreakdownFault:
    """Let vehicles break down: their bodies slow down in their lanes, and stand.

    Raises:
        BadInputError: values contradict each other.
    """

    at_s: float = field(validator=within(0.0, MAX_S))
    """Road time from which they may break down; a vehicle that moves or settles ends that first."""
    vehicle: str | None = None
    """Name of the vehicle; None: vehicles that fit the following fields are drawn."""
    count: int = field(default=1, validator=within(1, 100))
    """Number of vehicles; 1 with `vehicle`."""
    lane: int | None = field(default=None, validator=optional(within(0, 7)))
    """Lane of the vehicles; None: any."""
    at_m: float | None = field(default=None, validator=optional(within(0.0, LONGEST_ROAD_M)))
    """The vehicles are the first ones beyond this position; None: anywhere."""
    decel_mps2: float = field(default=3.0, validator=within(0.5, 10.0))
    for_s: float | None = field(default=None, validator=optional(within(0.0, MAX_S)))
    """Road time for which they stand; None: for ever."""

    def __attrs_post_init__(self) -> None:
        """Check that the fields do not contradict each other."""
        if self.vehicle is not None and self.count > 1:
            raise BadInputError("count", self.count, "1 with vehicle")


@frozen(kw_only=True)
class FaultSpec:
    """All faults of a run."""

    seed: int | None = field(default=None, validator=optional(within(0, 2**63 - 1)))
    """Seed of all draws; None: the seed of the scenario."""
    messages: tuple[MessageRule, ...] = ()
    kill: tuple[Kill, ...] = ()
    pause: tuple[Pause, ...] = ()
    partition: tuple[Partition, ...] = ()
    link: tuple[LinkFault, ...] = ()
    breakdown: tuple[BreakdownFault, ...] = ()

    def __bool__(self) -> bool:
        """Return whether there are any faults."""
        faults = self.messages, self.kill, self.pause, self.partition, self.link, self.breakdown
        return any(faults)

    def seed_of_run(self, scenario_seed: int) -> int:
        """Return the seed for all random draws: the file's, or else that of the scenario."""
        return scenario_seed if self.seed is None else self.seed

    def role_faults(self) -> Iterator[tuple[str, RoleFault]]:
        """Yield kills and pauses with their names, such as `kill[0]`."""
        for kind in ("kill", "pause"):
            for index, fault in enumerate(getattr(self, kind)):
                yield f"{kind}[{index}]", fault

    def partitions(self) -> Iterator[tuple[str, Partition]]:
        """Yield partitions with their names."""
        for index, partition in enumerate(self.partition):
            yield f"partition[{index}]", partition

    def breakdowns(self) -> Iterator[tuple[str, BreakdownFault]]:
        """Yield breakdowns with their names."""
        for index, fault in enumerate(self.breakdown):
            yield f"breakdown[{index}]", fault

    def timed_faults(self) -> Iterator[tuple[str, Partition | LinkFault]]:
        """Yield partitions and faults of links with their names."""
        yield from self.partitions()
        for index, fault in enumerate(self.link):
            yield f"link[{index}]", fault

    def windows(self) -> Iterator[tuple[str, MessageRule | Partition | LinkFault]]:
        """Yield all faults that are in force for a period of road time, with their names."""
        for index, rule in enumerate(self.messages):
            yield f"messages[{index}]", rule
        yield from self.timed_faults()

    def check_simulated(self) -> None:
        """Check that the simulated network supports these faults.

        Raises:
            BadInputError: a fault is not supported.
        """
        where = "with --transport simulated"
        for name, fault in self.role_faults():
            if isinstance(fault, Pause) and fault.target == ROUTER:
                raise BadInputError(f"{name}.target", ROUTER, f"any other target {where}")
        for name, partition in self.partitions():
            if partition.method == NAMESPACES:
                raise BadInputError(f"{name}.method", NAMESPACES, f"{MESSAGES} {where}")
        if self.link:
            allowed = (
                f"nothing {where}, which has no packets; use [[messages]] to lose or delay messages"
            )
            raise BadInputError("link", Described("a table"), allowed)

    def check_outside(self) -> None:
        """Check that these faults can be applied to a deployment from outside its processes.

        Raises:
            BadInputError: some cannot.
        """
        raise_all(self._impossible_outside())

    def _impossible_outside(self) -> Iterator[BadInputError]:
        where = "from outside"
        for name, faults, why in (
            ("messages", self.messages, "only a process itself can lose or delay messages"),
            ("partition", self.partition, "only processes themselves can lose messages"),
            ("link", self.link, "only links that `laneweave run` has made lose packets"),
            ("breakdown", self.breakdown, "the bridge lets vehicles break down"),
        ):
            if faults:
                allowed = f"nothing {where}: {why} (laneweave run --faults)"
                yield BadInputError(name, Described("a table"), allowed)
        for name, fault in self.role_faults():
            if fault.target == ROUTER:
                allowed = f"any other target {where}: a router has no token by which to find it"
                yield BadInputError(f"{name}.target", ROUTER, allowed)
            if isinstance(fault, Kill) and fault.restart_after_s is not None:
                allowed = f"nothing {where}: start the process again as it was started"
                yield BadInputError(f"{name}.restart_after_s", fault.restart_after_s, allowed)


def preset_names() -> tuple[str, ...]:
    """Return the names of the presets in alphabetical order."""
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in _presets().iterdir()))


def load_faults(
    choice: FaultSource,
    coordinators: Collection[str],
    vehicles: Collection[str] | None = None,
    *,
    name: str = "--faults",
) -> FaultSpec:
    """Return the faults of a file, a preset or tables.

    Args:
        choice: path of a file, or the name of a preset if no such file exists; tables as nested
            mappings and sequences, as in a file; None: no faults.
        coordinators: names of the run's coordinators.
        vehicles: names of the run's vehicles; None: accept any vehicle name.
        name: option or argument with the choice, for errors.

    Raises:
        BadInputError: the file or preset does not exist, or a value is not allowed.
    """
    if choice is None:
        return FaultSpec()
    if isinstance(choice, Mapping):
        return _faults(dict(choice), coordinators, vehicles)
    if not isinstance(choice, Path | str):
        raise BadInputError(name, choice, "tables of faults, a file, or the name of a preset")
    source = _source(choice, name)
    with source.located():
        return _faults(source.tables, coordinators, vehicles)


def _faults(
    tables: dict[str, Any], coordinators: Collection[str], vehicles: Collection[str] | None
) -> FaultSpec:
    specification = structure(tables, FaultSpec)
    raise_all(
        (
            *_unknown_processes(specification, coordinators, vehicles),
            *_unknown_targets(specification, coordinators, vehicles),
        )
    )
    return specification


def _unknown_processes(
    specification: FaultSpec, coordinators: Collection[str], vehicles: Collection[str] | None
) -> Iterator[BadInputError]:
    """Yield an error for each process in a message rule that the run does not have."""
    kinds = (*SENDERS, *coordinators)
    for index, rule in enumerate(specification.messages):
        fields = (("from", rule.sender), ("to", rule.receiver))
        for name, process in (*fields, *(("between", one) for one in rule.between or ())):
            if process in rule.names and not (
                process in coordinators or vehicles is None or process in vehicles
            ):
                allowed = _or_a_vehicle(kinds, vehicles)
                yield unknown_name(f"messages[{index}].{name}", process, kinds, allowed)


def _unknown_targets(
    specification: FaultSpec, coordinators: Collection[str], vehicles: Collection[str] | None
) -> Iterator[BadInputError]:
    """Yield an error for each target that the run does not have."""
    kinds = (LEADER, *coordinators, COORDINATOR, ROUTER, BRIDGE, AGENT)
    for name, fault in specification.role_faults():
        known = fault.target in kinds
        if not known and vehicles is not None and fault.target not in vehicles:
            allowed = _or_a_vehicle(kinds, vehicles)
            yield unknown_name(f"{name}.target", fault.target, kinds, allowed)
    for name, breakdown in specification.breakdowns():
        if None not in (vehicles, breakdown.vehicle) and breakdown.vehicle not in (vehicles or ()):
            allowed = f"the name of a vehicle of the run: {span_of(vehicles or ())}"
            yield BadInputError(f"{name}.vehicle", breakdown.vehicle, allowed)


def _or_a_vehicle(kinds: Collection[str], vehicles: Collection[str] | None) -> str:
    """Return the allowed targets as text."""
    text = f"{', '.join(kinds)}, or the name of a vehicle of the run"
    return f"{text}: {span_of(vehicles)}" if vehicles else text


def _source(choice: Path | str, name: str) -> SourceFile:
    path = Path(choice)
    names = preset_names()
    try:
        exists = path.exists()
    except OSError as error:
        raise BadInputError(name, str(choice), f"a file ({error.strerror})") from error
    if exists:
        return read_toml_source(path)
    if str(choice) not in names:
        allowed = f"a readable file, or one of {', '.join(names)}"
        raise unknown_name(name, str(choice), names, allowed)
    with as_file(_presets().joinpath(f"{choice}.toml")) as preset:
        return read_toml_source(preset)


def _presets() -> Traversable:
    return files("laneweave.launch.faults").joinpath("presets")
