"""Helpers for checks of fields: each raises a `BadInputError` that names the field."""

from __future__ import annotations

from collections.abc import Iterable
from operator import attrgetter, ge, gt, le, lt

from laneweave.protocol.errors import BadInputError, raise_all

_RELATIONS = {"at least": ge, "at most": le, "more than": gt, "less than": lt}
Comparison = tuple[str, str, float, str]
"""(field, relation, limit, description of the limit)."""


def require(ok: bool, name: str, value: object, allowed: str) -> None:
    """Raise an error unless a condition holds."""
    if not ok:
        raise BadInputError(name, value, allowed)


def compare(tables: object, comparisons: Iterable[Comparison]) -> None:
    """Check each field against its limit."""
    values = [(one, attrgetter(one[0])(tables)) for one in comparisons]
    raise_all(
        BadInputError(name, value, f"{relation} {limit:g}: {meaning}")
        for (name, relation, limit, meaning), value in values
        if not _RELATIONS[relation](value, limit)
    )
