"""Variants of a test: `make test` runs some, `make test-more` the others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

Parameters = Any
"""Values of one call of a test: a tuple, or a single value."""


def variants(every: Iterable[Parameters], count: int = 1) -> list[Any]:
    """Return parameters for `pytest.mark.parametrize`; all but the first are marked `more`.

    Args:
        every: parameters of the calls, or what `pytest.param` returns.
        count: number of those that `make test` runs.
    """
    return [each if n < count else _marked(each) for n, each in enumerate(every)]


def _marked(each: Parameters) -> Any:  # noqa: ANN401 (pytest's class of parameters is private)
    if hasattr(each, "marks"):
        return pytest.param(*each.values, id=each.id, marks=[*each.marks, pytest.mark.more])
    return pytest.param(*(each if isinstance(each, tuple) else (each,)), marks=pytest.mark.more)
