"""The frame buffer, and the messages that are made of frames."""

from __future__ import annotations

import json
from typing import Any

from laneweave.launch.watch.frames import (
    MAX_REQUESTED,
    FrameBuffer,
    batch,
    compact,
    opening,
    scene_of,
)
from laneweave.protocol.config.scenario_files import parse_scenario


def buffer(count: int, max_frames: int = 10, max_characters: int = 10**6) -> FrameBuffer:
    filled = FrameBuffer({"kind": "live"}, max_frames, max_characters)
    for _ in range(count):
        filled.append(compact({"n": filled.next}))
    return filled


def numbers(source: FrameBuffer, begin: int, end: int) -> list[int]:
    return [json.loads(frame)["n"] for frame in source.frames(begin, end)]


def test_the_oldest_frames_are_forgotten() -> None:
    full = buffer(25)
    assert (full.first, full.last) == (15, 24)
    assert numbers(full, 0, 99) == list(range(15, 25))
    assert numbers(full, 17, 19) == [17, 18, 19]
    assert numbers(full, 30, 40) == numbers(full, 0, 14) == []


def test_the_size_of_the_buffer_is_bounded() -> None:
    full = buffer(25, max_characters=30)
    assert numbers(full, 0, 99) == [22, 23, 24]
    assert numbers(buffer(25, max_characters=1), 0, 99) == [24]


def test_an_answer_is_one_message_of_bounded_size() -> None:
    source = buffer(200, max_frames=200)
    answer: dict[str, Any] = json.loads(batch(source, 3, 10**9))
    assert answer["reel"] == [3, 2 + MAX_REQUESTED]
    assert (answer["first"], answer["last"]) == (0, 199)
    assert [frame["n"] for frame in answer["frames"]] == list(range(3, 3 + MAX_REQUESTED))
    assert json.loads(batch(buffer(0), 0, 0))["frames"] == []


def test_the_scene_contains_the_numbers_of_frames() -> None:
    source = buffer(25)
    source.scene |= scene_of(parse_scenario({}), "live", "here", 0.1)
    scene = json.loads(opening(source, "this server"))["scene"]
    assert (scene["first"], scene["last"], scene["session"]) == (15, 24, "this server")
    assert (scene["kind"], scene["title"], scene["has_formations"]) == ("live", "here", True)
    assert len(scene["colours"]) == len(scene["legend"]) == scene["road"]["lanes"] == 3
