"""Tables of cases: one test for many rows that take microseconds each."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from functools import wraps
from typing import Any

Test = Callable[..., None]


def for_each(names: str | tuple[str, ...], rows: Iterable[Any]) -> Callable[[Test], Test]:
    """Call a test for all rows of a table; the failure has the rows that fail.

    As `pytest.mark.parametrize`, but one test in all: pytest spends milliseconds on each test,
    and each parallel worker collects all of them. Not for tests whose fixtures keep anything.

    Args:
        names: the parameters that a row fills in; a text names a single one, or several with
            commas.
        rows: tuples of values, or of `pytest.param`; values, if there is a single parameter.
    """
    single = isinstance(names, str) and "," not in names
    keys = [each.strip() for each in names.split(",")] if isinstance(names, str) else [*names]
    values = [_values(row, single=single) for row in rows]
    table = [dict(zip(keys, row, strict=True)) for row in values]
    assert table, "an empty table tests nothing"

    def decorate(test: Test) -> Test:
        @wraps(test)
        def run(**others: object) -> None:
            failures: list[tuple[BaseException, object]] = []
            for row in table:
                try:
                    test(**row, **others)
                except (KeyboardInterrupt, SystemExit):
                    raise
                except BaseException as failure:  # noqa: BLE001 (pytest's are no `Exception`)
                    failure.add_note(f"row: {row!r:.500}")
                    failures.append((failure, row))
            if failures:
                earliest = failures[0][0]
                further = "".join(f"\n  {row!r:.100}" for _, row in failures[1:20])
                if further:
                    earliest.add_note(f"{len(failures) - 1} further rows fail:{further}")
                raise earliest

        signature = inspect.signature(test)
        kept = [one for name, one in signature.parameters.items() if name not in keys]
        run.__signature__ = signature.replace(parameters=kept)  # type: ignore[attr-defined]
        return run

    return decorate


def _values(row: Any, *, single: bool) -> tuple[Any, ...]:  # noqa: ANN401 (any value)
    if hasattr(row, "marks"):  # what `pytest.param` returns
        return tuple(row.values)
    return (row,) if single else tuple(row)
