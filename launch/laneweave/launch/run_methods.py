"""Control methods, those of users among them, and their labelled variants for sweeps."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from attrs import field, frozen

from laneweave.protocol.config.scenario_files import parse_scenario, to_tables
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.plug_ins import PlugIns
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import PAPERS_FORMATIONS, FormationSettings

if TYPE_CHECKING:
    from laneweave.sim_bridge.baselines.reference_method import ReferenceMethod

FORMATION: Final = "formation"
"""Formation control by agents and coordinators."""
SUMO_HAS_DEMAND: Final = "none with a SUMO simulation, which has its own demand; --scale changes it"
RULE: Final = "rule"
LC2013: Final = "lc2013"
"""Reference methods: the rules of the paper, and SUMO's own lane changing."""

MAX_TAPPA_VEHICLES: Final = 6
"""Formations with more vehicles are planned by branching."""


class KeepTrajectories(StrEnum):
    """Runs of a sweep whose trajectories are kept."""

    none = "none"
    first_seed = "first-seed"
    all = "all"


@frozen
class LabelledMethod:
    """A control method with scenario settings."""

    method: str
    """Value of `laneweave run --method`."""
    overrides: Mapping[str, object] = field(factory=dict)
    """Scenario settings to replace, as `table.field`: value."""

    def with_overrides(self, overrides: Mapping[str, object]) -> LabelledMethod:
        """Return the method with other settings, which take precedence over its own."""
        return LabelledMethod(self.method, {**self.overrides, **overrides})

    def settings(self, base: Scenario) -> Scenario:
        """Return the scenario with these settings.

        Raises:
            BadInputError: the settings contradict the rest of the scenario.
        """
        tables = to_tables(base)
        for name, value in self.overrides.items():
            table, _, key = name.partition(".")
            tables[table][key] = value
        return parse_scenario(tables)


_FORMATIONS: Final = FormationSettings()


def _default() -> LabelledMethod:
    """Return formation control with the default settings, regardless of the scenario."""
    names = (
        "operation", "entry", "close", "cycle_s", "move_s", "max_vehicles", "max_columns",
        "targets", "solver",
    )  # fmt: skip
    return LabelledMethod(
        FORMATION, {f"formation.{name}": getattr(_FORMATIONS, name) for name in names}
    )


def _paper(max_vehicles: int, block_columns: int) -> LabelledMethod:
    """Return the paper's formations of at most `max_vehicles` in `block_columns` columns."""
    return LabelledMethod(
        FORMATION,
        {
            "formation.operation": "formations",
            **{f"formation.{name}": value for name, value in PAPERS_FORMATIONS.items()},
            "formation.move_s": None,
            "formation.max_vehicles": max_vehicles,
            "formation.block_columns": block_columns,
            "formation.solver": "tappa" if max_vehicles <= MAX_TAPPA_VEHICLES else "branching",
        },
    )


_SUMO_HUMAN: Final[dict[str, object]] = {
    "lc2013.headway_s": 1.0,
    "lc2013.min_gap_m": 2.5,
    "lc2013.imperfection": 0.5,
    "lc2013.accel_mps2": 2.6,
    "lc2013.decel_mps2": 4.5,
}
"""SUMO's defaults for passenger cars, except that all drivers desire v_F."""
_SUMO_IDEAL: Final[dict[str, object]] = {"lc2013.decel_mps2": 4.5}
"""Vehicles without imperfection that follow with moderate braking."""
_SUMO_COOPERATIVE: Final[dict[str, object]] = _SUMO_IDEAL | {
    "lc2013.min_gap_m": 1.0,
    "lc2013.strategic": 10.0,
    "lc2013.assertive": 2.0,
}
"""Vehicles that change lanes early and accept small gaps."""
_SUMO_TUNED: Final[dict[str, object]] = {
    "lc2013.min_gap_m": 0.224,
    "lc2013.accel_mps2": 3.68,
    "lc2013.decel_mps2": 4.55,
    "lc2013.strategic": 1.69,
    "lc2013.cooperative": 0.879,
    "lc2013.assertive": 1.58,
}
"""Found by `laneweave tune lc2013 --volumes 1000,1600,2000 --duration 300` on the paper's road: of
the sets with the shortest travel times, within 0.1 %, the one that brakes least hard."""
_SL2015: Final[dict[str, object]] = {"lc2013.model": "SL2015"}
_SL2015_TUNED: Final[dict[str, object]] = {
    **_SL2015,
    "lc2013.min_gap_m": 0.189,
    "lc2013.accel_mps2": 2.1,
    "lc2013.decel_mps2": 6.22,
    "lc2013.strategic": 0.85,
    "lc2013.cooperative": 0.597,
    "lc2013.assertive": 2.07,
}
"""The best of 24 sets of `laneweave tune sl2015 --volumes 1000,1600 --duration 300` on the paper's
road."""

METHODS: Final[dict[str, LabelledMethod]] = {
    "formation": LabelledMethod(FORMATION),
    "formations": _default(),
    "rolling": LabelledMethod(FORMATION, {"formation.operation": "rolling"}),
    "paper-6": _paper(6, 4),
    "paper-12": _paper(12, 8),
    "paper-18": _paper(18, 12),
    "rule": LabelledMethod(RULE),
    "rule-net": LabelledMethod(RULE, {"rule.gap": "net"}),
    "rule-yielding": LabelledMethod(RULE, {"rule.yielding": "all"}),
    "lc2013": LabelledMethod(LC2013),
    "lc2013-4s": LabelledMethod(LC2013, {"lc2013.lane_change_s": 4.0}),
    "lc2013-human": LabelledMethod(LC2013, _SUMO_HUMAN),
    "lc2013-ideal": LabelledMethod(LC2013, _SUMO_IDEAL),
    "lc2013-ideal-4s": LabelledMethod(LC2013, _SUMO_IDEAL | {"lc2013.lane_change_s": 4.0}),
    "lc2013-tuned": LabelledMethod(LC2013, _SUMO_TUNED),
    "lc2013-cooperative": LabelledMethod(LC2013, _SUMO_COOPERATIVE),
    "lc2013-cooperative-4s": LabelledMethod(
        LC2013, _SUMO_COOPERATIVE | {"lc2013.lane_change_s": 4.0}
    ),
    "sl2015": LabelledMethod(LC2013, _SL2015),
    "sl2015-human": LabelledMethod(LC2013, _SUMO_HUMAN | _SL2015),
    "sl2015-ideal": LabelledMethod(LC2013, _SUMO_IDEAL | _SL2015),
    "sl2015-tuned": LabelledMethod(LC2013, _SL2015_TUNED),
    "sl2015-cooperative": LabelledMethod(LC2013, _SUMO_COOPERATIVE | _SL2015),
}
"""Built-in methods by label, in the order of tables and figures."""

REFERENCE_METHODS: Final = PlugIns(
    kind="method",
    group="laneweave.methods",
    built_in={
        RULE: "laneweave.sim_bridge.baselines.rule_based:RuleMethod",
        LC2013: "laneweave.sim_bridge.baselines.lc2013:Lc2013Method",
    },
    reserved=frozenset(METHODS),
)
"""All reference methods: each is a `ReferenceMethod`. The label of a plug-in is its name."""


def labelled(label: str) -> LabelledMethod:
    """Return the method of a label; a label that is not built in is the name of a plug-in."""
    return METHODS.get(label) or LabelledMethod(label)


def reference_method(name: str, field_name: str = "method") -> ReferenceMethod:
    """Return a reference method.

    Raises:
        BadInputError: there is no such method, or a plug-in cannot be loaded.
    """
    from laneweave.sim_bridge.baselines.reference_method import ReferenceMethod  # noqa: PLC0415 (needs extra `sim`)

    found = REFERENCE_METHODS.load(name, field_name)
    if not isinstance(found, ReferenceMethod):
        allowed = f"a ReferenceMethod; that of {REFERENCE_METHODS.origin(name)} is none"
        raise BadInputError(field_name, name, allowed)
    return found


def checked_method(name: str, field_name: str) -> str:
    """Return the name of a method that is built in, or a plug-in that is installed.

    Raises:
        BadInputError: there is no such method.
    """
    if name != FORMATION:
        REFERENCE_METHODS.checked(name, field_name, (FORMATION,))
    return name


_OF_METHODS = (RULE, LC2013)
"""Tables of a scenario that only the method of the same name reads."""
_OF_FORMATION_CONTROL = ("formation", "sensing", "braking", "tracking", "network", "radio")
"""Tables of a scenario that built-in reference methods do not read, except `_READ_BY_ALL`."""
_READ_BY_ALL = "formation.speed_mps"
_WITHOUT_EFFECT = (
    "security", "service", "observation",
    "network.endpoint", "network.listen", "network.realm", "runtime.max_pace", "sumo.gui",
)  # fmt: skip
"""Tables and fields of a scenario that do not affect the results of runs."""


def affects(field_name: str, method: str) -> bool:
    """Return whether a field (`table.field`) of a scenario can change the results of a method."""
    table = field_name.partition(".")[0]
    if table in _WITHOUT_EFFECT or field_name in _WITHOUT_EFFECT:
        return False
    if method == FORMATION:
        return table not in _OF_METHODS
    if field_name == _READ_BY_ALL or not REFERENCE_METHODS.is_built_in(method):
        return True  # nothing is known about a plug-in
    return table == method or table not in (*_OF_METHODS, *_OF_FORMATION_CONTROL)


def parse_methods(text: str) -> tuple[str, ...]:
    """Return the labels in a comma-separated list.

    Raises:
        BadInputError: a label is unknown or repeated.
    """
    labels = tuple(text.split(","))
    for number, label in enumerate(labels):
        if label not in METHODS:
            REFERENCE_METHODS.checked(label, "--methods", METHODS)
        if label in labels[:number]:
            raise BadInputError("--methods", text, f"{label} only once")
    return labels


def rank(label: str) -> tuple[int, str]:
    """Return the sort key of a label: in the order of `METHODS`, unknown labels last."""
    known = list(METHODS)
    return (known.index(label) if label in METHODS else len(known), label)
