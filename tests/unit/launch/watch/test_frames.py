"""Frames in a ring, and the answers that are made of them."""

from __future__ import annotations

import json
from typing import Any

from laneweave.launch.watch.frame_buffer import Ring
from laneweave.launch.watch.frames import MOST_WANTED, compact, opening, reel, scene_of
from laneweave.protocol.config.loading import parse_scenario


def ring(count: int, most_frames: int = 10, most_characters: int = 10**6) -> Ring:
    filled = Ring({"kind": "live"}, most_frames, most_characters)
    for _ in range(count):
        filled.append(compact({"n": filled.next}))
    return filled


def numbers(film: Ring, begin: int, end: int) -> list[int]:
    return [json.loads(frame)["n"] for frame in film.frames(begin, end)]


def test_an_empty_ring() -> None:
    empty = ring(0)
    assert (empty.first, empty.last, numbers(empty, 0, 5)) == (0, -1, [])


def test_the_oldest_frames_are_forgotten() -> None:
    full = ring(25)
    assert (full.first, full.last) == (15, 24)
    assert numbers(full, 0, 99) == list(range(15, 25))
    assert numbers(full, 17, 19) == [17, 18, 19]
    assert numbers(full, 30, 40) == numbers(full, 0, 14) == []


def test_big_frames_leave_room_for_fewer() -> None:
    full = ring(25, most_characters=30)
    assert numbers(full, 0, 99) == [22, 23, 24]
    assert numbers(ring(25, most_characters=1), 0, 99) == [24]


def test_an_answer_is_one_message_of_bounded_size() -> None:
    film = ring(200, most_frames=200)
    answer: dict[str, Any] = json.loads(reel(film, 3, 10**9))
    assert answer["reel"] == [3, 2 + MOST_WANTED]
    assert (answer["first"], answer["last"]) == (0, 199)
    assert [frame["n"] for frame in answer["frames"]] == list(range(3, 3 + MOST_WANTED))
    assert json.loads(reel(ring(0), 0, 0))["frames"] == []


def test_the_scene_says_what_there_is() -> None:
    film = ring(25)
    film.scene |= scene_of(parse_scenario({}), "live", "here", 0.1)
    scene = json.loads(opening(film, "this server"))["scene"]
    assert (scene["first"], scene["last"], scene["session"]) == (15, 24, "this server")
    assert (scene["kind"], scene["title"], scene["rolling"]) == ("live", "here", False)
    assert len(scene["colours"]) == len(scene["names"]) == scene["road"]["lanes"] == 3
