"""Classes that are frozen for type checkers only: as `frozen` in all else."""

from __future__ import annotations

from attrs import evolve, field, frozen

from laneweave.protocol.quick_frozen import quick_frozen


@quick_frozen
class Quick:
    number: int
    names: tuple[str, ...] = field(factory=tuple)


@frozen
class Frozen:
    number: int
    names: tuple[str, ...] = field(factory=tuple)


def test_equality_hash_order_of_fields_and_slots() -> None:
    one = Quick(1, ("a",))
    assert one == Quick(1, ("a",))
    assert one != Quick(1, ("b",))
    assert {one: 2}[Quick(1, ("a",))] == 2
    assert evolve(one, number=3) == Quick(3, ("a",))
    assert repr(one) == repr(Frozen(1, ("a",))).replace("Frozen", "Quick")
    assert not hasattr(one, "__dict__")


def test_assignment_is_an_error_for_type_checkers() -> None:
    # mypy would report this comment as unused if the class were not frozen for it.
    one = Quick(1)
    one.number = 2  # type: ignore[misc]
    assert one.number == 2  # at run time, nothing prevents it
