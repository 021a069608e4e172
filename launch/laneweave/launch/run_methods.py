"""The methods of control, and the labels of a sweep: each names a method and its settings."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Final

from attrs import field, frozen

from laneweave.protocol.config.loading import parse_scenario, to_tables
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import PAPERS_FORMATIONS, FormationSettings, Scenario

FORMATION: Final = "formation"
"""Formation control, by this project's agents and coordinators."""
RULE: Final = "rule"
LC2013: Final = "lc2013"
"""The two reference methods: the paper's rules, and SUMO's own lane changing."""

MAX_TAPPA_VEHICLES: Final = 6
"""Larger formations are planned by branching."""


class KeepTrajectories(StrEnum):
    """Which runs of a sweep keep their trajectories."""

    none = "none"
    first_seed = "first-seed"
    all = "all"


@frozen
class LabelledMethod:
    """A method with settings."""

    method: str
    """As `laneweave run --method` names it."""
    meaning: str
    overrides: Mapping[str, object] = field(factory=dict)
    """`table.field` -> value that replaces the scenario's."""

    def settings(self, base: Scenario) -> Scenario:
        """Return a scenario with these settings.

        Raises:
            BadInputError: they do not fit the rest of the scenario.
        """
        tables = to_tables(base)
        for name, value in self.overrides.items():
            table, _, key = name.partition(".")
            tables[table][key] = value
        return parse_scenario(tables)


_FORMATIONS: Final = FormationSettings()


def _default() -> LabelledMethod:
    """Return formations with the default settings, whatever the scenario sets."""
    names = ("operation", "entry", "close", "cycle_s", "move_s", "max_vehicles", "max_columns")
    return LabelledMethod(
        FORMATION,
        f"formations of at most {_FORMATIONS.max_vehicles} vehicles, as long as traffic makes them",
        {f"formation.{name}": getattr(_FORMATIONS, name) for name in names}
        | _solver(_FORMATIONS.max_vehicles),
    )


def _paper(max_vehicles: int, block_columns: int) -> LabelledMethod:
    """Return the paper's formations of at most `max_vehicles` in `block_columns` columns."""
    return LabelledMethod(
        FORMATION,
        f"the paper's formations, of at most {max_vehicles} vehicles in {block_columns} columns",
        {
            "formation.operation": "formations",
            **{f"formation.{name}": value for name, value in PAPERS_FORMATIONS.items()},
            "formation.move_s": None,
            "formation.max_vehicles": max_vehicles,
            "formation.block_columns": block_columns,
        }
        | _solver(max_vehicles),
    )


def _solver(max_vehicles: int) -> dict[str, object]:
    """Return the setting of the solver for formations of at most `max_vehicles`."""
    return {"formation.solver": "tappa" if max_vehicles <= MAX_TAPPA_VEHICLES else "branching"}


METHODS: Final[dict[str, LabelledMethod]] = {
    "formation": LabelledMethod(FORMATION, "formation control as the scenario says"),
    "formations": _default(),
    "rolling": LabelledMethod(
        FORMATION, "the whole stream, planned anew in each slot", {"formation.operation": "rolling"}
    ),
    "paper-6": _paper(6, 4),
    "paper-12": _paper(12, 8),
    "paper-18": _paper(18, 12),
    "rule": LabelledMethod(RULE, "the paper's rules, d_R from front to front"),
    "rule-net": LabelledMethod(RULE, "the paper's rules, d_R as a net gap", {"rule.gap": "net"}),
    "rule-yielding": LabelledMethod(
        RULE, "the paper's rules, every vehicle yields", {"rule.yielding": "all"}
    ),
    "lc2013": LabelledMethod(LC2013, "SUMO's own lane changing and Krauss following"),
    "lc2013-4s": LabelledMethod(
        LC2013, "the same with lane changes of 4 s", {"lc2013.lane_change_s": 4.0}
    ),
}
"""By label, in the order of tables and figures."""


_READ_BY_ALL = ("schema", "seed", "road", "demand", "vehicle", "runtime", "formation.speed_mps")
"""Tables and fields of a scenario that any method may read."""

_WITHOUT_EFFECT = ("security", "service", "observation")
"""Tables that do not change any run."""


def affects(field_name: str, method: str) -> bool:
    """Tell whether a field of a scenario can change the results of a method.

    Args:
        field_name: `table.field`, or the name of a field outside tables.
        method: as `laneweave run --method` names it.
    """
    table = field_name.partition(".")[0]
    if table in _WITHOUT_EFFECT:
        return False
    if method == FORMATION:
        return table not in (RULE, LC2013)
    return table == method or table in _READ_BY_ALL or field_name in _READ_BY_ALL


def parse_methods(text: str) -> tuple[str, ...]:
    """Return the labels of a comma-separated list.

    Raises:
        BadInputError: a label is unknown or named twice.
    """
    labels = tuple(text.split(","))
    for number, label in enumerate(labels):
        if label not in METHODS:
            raise BadInputError("--methods", label, "some of " + ", ".join(METHODS))
        if label in labels[:number]:
            raise BadInputError("--methods", text, f"{label} only once")
    return labels


def rank(label: str) -> tuple[int, str]:
    """Return the sort key of a label: its place in `METHODS`, unknown labels last."""
    known = list(METHODS)
    return (known.index(label) if label in METHODS else len(known), label)
