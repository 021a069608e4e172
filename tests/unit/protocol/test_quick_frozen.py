"""Classes that are frozen for type checkers only: as `frozen` in all else."""

from __future__ import annotations

from laneweave.protocol.quick_frozen import quick_frozen


@quick_frozen
class Quick:
    number: int


def test_assignment_is_an_error_for_type_checkers() -> None:
    # mypy would report this comment as unused if the class were not frozen for it.
    one = Quick(1)
    one.number = 2  # type: ignore[misc]
    assert one == Quick(2), "at run time, nothing prevents it"
    assert {one: 3}[Quick(2)] == 3
