"""What is no longer shown is forgotten; what is only late changes nothing."""

from __future__ import annotations

import pytest

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.wire.newest import AHEAD_S, FORGET_S, Newest, NewestRoad

PACE = 10.0


def test_lower_values_are_late() -> None:
    newest = Newest()
    for value, now_s, taken in ((5, 0.0, True), (4, 0.1, False), (5, 0.2, True), (7, 0.3, True)):
        assert newest.take(value, now_s) is taken
    assert (newest.value, newest.shown_s) == (7, 0.3)


def test_a_value_is_forgotten_when_only_lower_ones_arrive() -> None:
    newest = Newest()
    newest.take(99, 0.0)
    assert not newest.take(4, 8.0)  # after a pause, too, what is late comes first
    assert not newest.take(5, 8.0 + FORGET_S - 0.01)
    assert newest.take(6, 8.0 + FORGET_S)
    assert newest.take(7, 9.0)
    assert newest.value == 7


def test_a_value_that_is_shown_again_is_not_forgotten() -> None:
    newest = Newest()
    newest.take(9, 0.0)
    for tenth in range(1, 50):
        assert not newest.take(4, tenth / 10)
        assert newest.take(9, tenth / 10 + 0.05)


def test_a_value_far_ahead_is_taken_only_if_no_other_arrives() -> None:
    newest = Newest()
    newest.take(1, 0.0)
    assert not newest.take(99, 0.1, ahead=True)
    assert newest.take(2, 0.2)
    assert not newest.take(99, 0.3, ahead=True)
    assert newest.take(99, 0.3 + FORGET_S, ahead=True)


def test_a_newer_bridge_has_a_new_road() -> None:
    road = NewestRoad(PACE)
    assert (road.bridge, road.t_s) == (-1, 0.0)
    assert road.on_message(7, 30.0, 1.0)
    number = road.number
    road.on_token_up(8, 2.0)
    assert (road.bridge, road.t_s, road.number) == (8, 0.0, number + 1)
    assert not road.on_message(7, 30.1, 2.1)
    assert road.on_message(0, 0.1, 2.1)  # its bridge is not given
    assert (road.bridge, road.t_s, road.number) == (8, 0.1, number + 1)


def test_when_its_token_vanishes_the_newest_bridge_that_has_one_counts() -> None:
    road = NewestRoad(PACE)
    for bridge in (7, 6, 9, 8):
        road.on_token_up(bridge, 0.0)
    road.on_token_down(6, 1.0)
    assert road.bridge == 9
    road.on_token_down(9, 1.0)
    assert road.bridge == 8
    road.on_token_down(8, 1.0)
    road.on_token_down(7, 1.0)  # the own connection may be lost
    assert road.bridge == 7


def test_tokens_from_before_a_lost_connection_do_not_count() -> None:
    road = NewestRoad(PACE)
    road.on_token_up(7, 0.0)
    road.on_link_down()
    road.on_token_up(8, 1.0)  # 7 exited meanwhile
    road.on_token_down(8, 2.0)
    assert road.bridge == 8


def test_a_bridge_that_shows_nothing_is_forgotten_while_another_one_does() -> None:
    road = NewestRoad(PACE)
    road.on_message(7, 30.0, 0.0)
    road.on_message(9, 1.0, 0.1)
    assert not road.on_message(7, 30.2, 0.2)
    assert road.on_message(7, 30.8, 0.2 + FORGET_S)
    assert (road.bridge, road.t_s) == (7, 30.8)


def test_a_road_time_far_ahead_is_refused() -> None:
    road = NewestRoad(PACE)
    road.on_message(7, 30.0, 1.0)
    road.on_message(7, 30.0 + AHEAD_S, 1.0)
    with pytest.raises(BadInputError):
        road.on_message(7, 30.0 + 2.1 * AHEAD_S, 1.0)
    assert road.t_s == 30.0 + AHEAD_S
    road.on_message(7, 30.0 + 2.1 * AHEAD_S, 1.0 + 0.2 * AHEAD_S / PACE)


def test_a_late_road_time_is_of_the_same_road() -> None:
    road = NewestRoad(PACE)
    road.on_message(7, 30.0, 1.0)
    number = road.number
    assert road.on_message(7, 29.0, 1.1)
    assert (road.t_s, road.number) == (30.0, number)


def test_a_road_time_that_was_wrong_is_forgotten_with_all_that_followed_from_it() -> None:
    road = NewestRoad(PACE)
    road.on_message(7, 30.0, 1.0)
    road.on_message(7, 39.0, 1.1)
    number = road.number
    road.on_message(7, 30.2, 1.2)
    assert road.t_s == 39.0
    road.on_message(7, 30.2 + FORGET_S, 1.2 + FORGET_S)
    assert (road.t_s, road.number) == (30.2 + FORGET_S, number + 1)
