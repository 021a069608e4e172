"""Helpers for checks of fields: each raises a `BadInputError` that names the field."""

from __future__ import annotations

from collections.abc import Iterable
from operator import attrgetter, ge, gt, le, lt

from laneweave.protocol.errors import BadInputError, raise_all

_RELATIONS = {"at least": ge, "at most": le, "more than": gt, "less than": lt}
Comparison = tuple[str, str, float, str]
"""(field, relation, limit, description of the limit)."""


def require(
    ok: bool, name: str, value: object, allowed: str, at_least: float | None = None
) -> None:
    """Raise an error unless a condition holds; `at_least` is named before what it is for."""
    if not ok:
        limit = "" if at_least is None else f"at least {at_least:g}: "
        raise BadInputError(name, value, limit + allowed, at_least=at_least)


def compare(tables: object, comparisons: Iterable[Comparison]) -> None:
    """Check each field against its limit."""
    values = [(one, attrgetter(one[0])(tables)) for one in comparisons]
    raise_all(
        BadInputError(
            name,
            value,
            f"{relation} {limit:g}: {meaning}",
            at_least=limit if relation == "at least" else None,
        )
        for (name, relation, limit, meaning), value in values
        if not _RELATIONS[relation](value, limit)
    )
