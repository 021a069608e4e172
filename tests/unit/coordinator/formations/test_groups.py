"""Joined formations: a group is all that are joined with each other, and it only grows."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.formations.roster import Groups, Numbers

JOINS = st.lists(st.lists(st.integers(-3, 9), max_size=4), max_size=8)


def components(joins: list[list[int]]) -> dict[int, Numbers]:
    """Return the group of each number that was ever named, found the slow way."""
    groups: list[set[int]] = []
    for numbers in joins:
        meeting = [group for group in groups if group & set(numbers)]
        groups = [group for group in groups if group not in meeting]
        groups.append(set(numbers).union(*meeting))
    return {number: tuple(sorted(group)) for group in groups for number in group}


def test_alone_unless_joined() -> None:
    assert Groups().of(7) == (7,)


def test_all_members_know_their_group_in_ascending_order() -> None:
    groups = Groups()
    assert groups.join((4, 2))
    assert [groups.of(number) for number in (2, 3, 4)] == [(2, 4), (3,), (2, 4)]


def test_groups_that_share_a_member_become_one() -> None:
    groups = Groups()
    groups.join((0, 1))
    groups.join((2, 3))
    assert groups.join((3, 1))
    assert {groups.of(number) for number in range(4)} == {(0, 1, 2, 3)}


def test_join_returns_whether_it_was_new() -> None:
    groups = Groups()
    for numbers, new in (
        ((), False),
        ((5,), False),
        ((5, 5), False),
        ((1, 2), True),
        ((2, 1), False),
        ((2,), False),
        ((0, 2), True),
        ((0, 1), False),
    ):
        assert groups.join(numbers) is new


def test_another_road_begins_without_groups() -> None:
    groups = Groups()
    groups.join((0, 1))
    groups.forget()
    assert groups.of(0) == (0,)


@given(JOINS)
def test_groups_are_connected_components(joins: list[list[int]]) -> None:
    groups = Groups()
    for index, numbers in enumerate(joins):
        known = {number: groups.of(number) for number in range(-3, 10)}
        changed = groups.join(numbers)
        found = {number: groups.of(number) for number in range(-3, 10)}
        assert changed == (found != known)
        expected = components(joins[: index + 1])
        assert found == {number: expected.get(number, (number,)) for number in found}
        assert all(set(known[number]) <= set(found[number]) for number in found)
