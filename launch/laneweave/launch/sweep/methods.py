"""The labels of a sweep: each names a method and the settings that it is run with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from attrs import field, frozen

from laneweave.launch.cli.role_commands import LC2013, METHOD, RULE
from laneweave.protocol.config.loading import parse_scenario, to_tables
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.tables import PAPERS_FORMATIONS, FormationSettings, Scenario

LARGEST_OF_TAPPA: Final = 6
"""Larger formations are planned by branching."""


@frozen
class LabelledMethod:
    """A method with settings."""

    method: str
    """As `laneweave run --method` names it."""
    meaning: str
    overrides: Mapping[str, object] = field(factory=dict)
    """`table.field` -> value, in place of the scenario's."""

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
    """Return formations as they are by default, whatever the scenario says of them."""
    names = ("operation", "entry", "close", "cycle_s", "move_s", "max_vehicles", "max_columns")
    return LabelledMethod(
        METHOD,
        f"formations of at most {_FORMATIONS.max_vehicles} vehicles, as long as traffic makes them",
        {f"formation.{name}": getattr(_FORMATIONS, name) for name in names}
        | _solver(_FORMATIONS.max_vehicles),
    )


def _paper(max_vehicles: int, block_columns: int) -> LabelledMethod:
    """Return the paper's formations, of at most so many vehicles in so many columns."""
    return LabelledMethod(
        METHOD,
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
    """Return what chooses the planner of formations of at most so many vehicles."""
    return {"formation.solver": "tappa" if max_vehicles <= LARGEST_OF_TAPPA else "branching"}


METHODS: Final[dict[str, LabelledMethod]] = {
    "formation": LabelledMethod(METHOD, "formation control as the scenario says"),
    "formations": _default(),
    "rolling": LabelledMethod(
        METHOD, "the whole stream, planned anew in each slot", {"formation.operation": "rolling"}
    ),
    "paper-6": _paper(6, 4),
    "paper-12": _paper(12, 8),
    "paper-18": _paper(18, 12),
    "rule": LabelledMethod(RULE, "the paper's rules, d_R from front to front"),
    "rule-net": LabelledMethod(RULE, "the paper's rules, d_R as a net gap", {"rule.gap": "net"}),
    "rule-yielding": LabelledMethod(
        RULE, "the paper's rules, everybody gives way", {"rule.yielding": "all"}
    ),
    "lc2013": LabelledMethod(LC2013, "SUMO's own lane changing and Krauss following"),
    "lc2013-4s": LabelledMethod(
        LC2013, "the same with lane changes of 4 s", {"lc2013.lane_change_s": 4.0}
    ),
}
"""In the order in which tables and figures show them."""


_EVERYBODY = ("schema", "seed", "road", "demand", "vehicle", "runtime", "formation.speed_mps")
"""Tables and fields of a scenario that any method may read."""

_NOBODY = ("security", "service", "observation")
"""Tables that change no run."""


def has_a_say(field_name: str, method: str) -> bool:
    """Tell whether a field of a scenario can change what a method's runs bring.

    Args:
        field_name: `table.field`, or the name of a field outside tables.
        method: as `laneweave run --method` names it.
    """
    table = field_name.partition(".")[0]
    if table in _NOBODY:
        return False
    if method == METHOD:
        return table not in (RULE, LC2013)
    return table == method or table in _EVERYBODY or field_name in _EVERYBODY


def parse_methods(text: str) -> tuple[str, ...]:
    """Return the labels of a list with commas.

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
    """Return by what labels are sorted: their place in the table, unknown ones behind them."""
    known = list(METHODS)
    return (known.index(label) if label in METHODS else len(known), label)
