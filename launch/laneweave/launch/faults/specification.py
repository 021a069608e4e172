"""Faults to inject into a run: what a faults file may say. docs/FAULTS.md is its reference.

A file has tables `[[messages]]`, `[[kill]]`, `[[pause]]` and `[[partition]]`, any number of each.
Times at which something happens are road time; durations of processes' fates are wall-clock time.
What ships with the package are presets, named instead of a file.
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Iterator
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import attrs
from attrs import field, frozen
from attrs.validators import optional

from laneweave.protocol.config.loading import read_toml
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.message_faults import SENDERS, MessageRule
from laneweave.protocol.structuring import NumberOrRange, structure
from laneweave.protocol.validators import one_of, within

LEADER, COORDINATOR, ROUTER, AGENT = "leader", "coordinator", "router", "agent"
SENDER_OF_GROUP = dict(zip(("vehicles", "coordinators", "bridge"), SENDERS, strict=True))
"""The groups that a partition may cut apart, and who is in them, as message rules name it."""
GROUPS = tuple(SENDER_OF_GROUP)
OTHERS = "others"
AUTO, NAMESPACES, MESSAGES = "auto", "namespaces", "messages"
MOST_S = 1e6
MOST_TIMES = 10_000
LEAST_EVERY_S = 0.1
"""Faults that repeat are looked for once in a tick."""


def _range(_: object, attribute: attrs.Attribute[Any], value: tuple[float, float]) -> None:
    first, last = value
    if not 0.0 <= first <= last <= MOST_S:
        raise BadInputError(attribute.name, value, f"[a, b] with 0 <= a <= b <= {MOST_S:g}")


def _duration(_: object, attribute: attrs.Attribute[Any], value: NumberOrRange) -> None:
    first, last = value if isinstance(value, tuple) else (value, value)
    if not 0.0 < first <= last <= 600.0:
        raise BadInputError(
            attribute.name, value, "a number in (0, 600], or [a, b] with 0 < a <= b <= 600"
        )


@frozen(kw_only=True)
class Strike:
    """Whom a fault strikes, when, and how often: what kills and pauses have in common.

    Raises:
        BadInputError: a value is not acceptable, or values do not fit together.
    """

    target: str = LEADER
    """`leader`, `router`, any `coordinator`, any `agent` on the road, or the name of a coordinator
    or a vehicle."""
    count: int = field(default=1, validator=within(1, 10_000))
    """How many of them, each another one; only for `agent` and `coordinator`."""
    at_s: float | None = field(default=None, validator=optional(within(0.0, MOST_S)))
    """Road time. Either this or `between_s`."""
    between_s: tuple[float, float] | None = field(default=None, validator=optional(_range))
    """Road times between which a time is drawn, for each target and each time."""
    every_s: float | None = field(default=None, validator=optional(within(LEAST_EVERY_S, MOST_S)))
    """Again after so much road time; with `at_s`."""
    times: int | None = field(default=None, validator=optional(within(1, MOST_TIMES)))
    """How often in all; none: once, or with `every_s` to the end of the run."""

    def __attrs_post_init__(self) -> None:
        """Check how the fields fit together."""
        if self.at_s is None and self.between_s is None:
            raise BadInputError("at_s", "nothing", "a road time, or between_s instead")
        if self.at_s is not None and self.between_s is not None:
            raise BadInputError("between_s", self.between_s, "nothing where at_s is given")
        if self.every_s is not None and self.at_s is None:
            raise BadInputError("every_s", self.every_s, "nothing without at_s")
        if self.times is not None and self.at_s is not None and self.every_s is None:
            raise BadInputError("times", self.times, "nothing without every_s or between_s")
        if self.count * (self.times or 1) > MOST_TIMES:
            raise BadInputError("times", self.times, f"count * times of at most {MOST_TIMES}")
        if self.count > 1 and self.target not in (AGENT, COORDINATOR):
            raise BadInputError("count", self.count, f"1 for any target but {AGENT}, {COORDINATOR}")

    @property
    def from_s(self) -> float:
        """Road time before which nothing happens."""
        return self.at_s if self.at_s is not None else (self.between_s or (0.0, 0.0))[0]


@frozen(kw_only=True)
class Kill(Strike):
    """SIGKILL processes, and perhaps start them again with an empty memory."""

    restart_after_s: float | None = field(default=None, validator=optional(within(0.0, 600.0)))
    """Wall-clock seconds; none: it stays dead."""
    restart_share: float = field(default=1.0, validator=within(0.0, 1.0))
    """Which share of those that were killed is started again."""

    def __attrs_post_init__(self) -> None:
        """Check how the fields fit together."""
        super().__attrs_post_init__()
        if self.restart_share < 1.0 and self.restart_after_s is None:
            raise BadInputError("restart_share", self.restart_share, "1 without restart_after_s")


@frozen(kw_only=True)
class Pause(Strike):
    """SIGSTOP processes, and SIGCONT them later: they come back as zombies."""

    for_s: NumberOrRange = field(validator=_duration)
    """Wall-clock seconds; a range: drawn for each pause."""


@frozen(kw_only=True)
class Partition:
    """Cut a group off, or two groups from each other, for some road time.

    Raises:
        BadInputError: a value is not acceptable, or values do not fit together.
    """

    between: tuple[str, str]
    """Two groups, or a group and `others`: all that are not in it."""
    from_s: float = field(default=0.0, validator=within(0.0, MOST_S))
    until_s: float | None = field(default=None, validator=optional(within(0.0, MOST_S)))
    """Road time; none: to the end of the run."""
    method: str = field(default=AUTO, validator=one_of(AUTO, NAMESPACES, MESSAGES))

    def __attrs_post_init__(self) -> None:
        """Check how the fields fit together."""
        first, second = self.between
        if first == second or first not in GROUPS or second not in (*GROUPS, OTHERS):
            allowed = f"two of {', '.join(GROUPS)}, or one of them and then {OTHERS}"
            raise BadInputError("between", list(self.between), allowed)
        if self.until_s is not None and self.until_s <= self.from_s:
            raise BadInputError("until_s", self.until_s, f"more than from_s, {self.from_s:g}")
        if self.method == NAMESPACES and second != OTHERS:
            # One router carries everything: without its link a group is cut off from all.
            raise BadInputError("method", NAMESPACES, f"{MESSAGES}, or {OTHERS} in between")

    def holds(self, road_s: float) -> bool:
        """Tell whether the partition is in force at a road time."""
        return self.from_s <= road_s and (self.until_s is None or road_s < self.until_s)

    @property
    def may_use_links(self) -> bool:
        """Whether taking a link down does what is wanted."""
        return self.between[1] == OTHERS and self.method != MESSAGES

    def message_rules(self) -> Iterator[MessageRule]:
        """Yield rules that lose every message from one side to the other."""
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
class Faults:
    """All faults of a run."""

    seed: int | None = field(default=None, validator=optional(within(0, 2**63 - 1)))
    """Seed of everything drawn; none: the scenario's."""
    messages: tuple[MessageRule, ...] = ()
    kill: tuple[Kill, ...] = ()
    pause: tuple[Pause, ...] = ()
    partition: tuple[Partition, ...] = ()

    def __bool__(self) -> bool:
        """Tell whether there are any."""
        return bool(self.messages or self.kill or self.pause or self.partition)

    def strikes(self) -> Iterator[tuple[str, Strike]]:
        """Yield kills and pauses, each with its name in the file."""
        for kind in ("kill", "pause"):
            for index, strike in enumerate(getattr(self, kind)):
                yield f"{kind}[{index}]", strike

    def windows(self) -> Iterator[tuple[str, float]]:
        """Yield what holds for some time: its name in the file, and from when."""
        for index, rule in enumerate(self.messages):
            yield f"messages[{index}]", rule.from_s
        for index, partition in enumerate(self.partition):
            yield f"partition[{index}]", partition.from_s


def preset_names() -> tuple[str, ...]:
    """Return the names of the presets, in alphabetical order."""
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in _presets().iterdir()))


def load_faults(
    choice: Path | str | None,
    coordinators: Collection[str],
    vehicles: Collection[str] | None = None,
) -> Faults:
    """Read a faults file or a preset; None means no faults.

    Args:
        choice: path of a file, or the name of a preset where there is no such file.
        coordinators: names of the run's coordinators.
        vehicles: names of the run's vehicles; None: any name is taken for a vehicle's.

    Raises:
        BadInputError: there is no such file or preset, or a value is not acceptable.
    """
    if choice is None:
        return Faults()
    faults = structure(_tables(choice), Faults)
    kinds = (LEADER, *coordinators, COORDINATOR, ROUTER, AGENT)
    for name, strike in faults.strikes():
        known = strike.target in kinds
        if not known and vehicles is not None and strike.target not in vehicles:
            allowed = f"{', '.join(kinds)}, or the name of a vehicle of the run"
            raise BadInputError(f"{name}.target", strike.target, allowed)
    return faults


def _tables(choice: Path | str) -> dict[str, Any]:
    path = Path(choice)
    if path.exists():
        return read_toml(path)
    if str(choice) not in preset_names():
        presets = ", ".join(preset_names())
        raise BadInputError("--faults", str(choice), f"a readable file, or one of {presets}")
    text = _presets().joinpath(f"{choice}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def _presets() -> Traversable:
    return files("laneweave.launch.faults").joinpath("presets")
