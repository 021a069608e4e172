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
