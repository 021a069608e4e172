"""Reading recorded events: lines that are cut off, damaged files, the order of time."""

from __future__ import annotations

from pathlib import Path

import pytest

from laneweave.launch.explain.explanation import explain
from laneweave.launch.library.recorded_run import RecordedRun
from laneweave.launch.recordings.events import read_events
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from support.summaries import make_summary

ENTERED = '{"t_s": 3.0, "kind": "entered", "role": "bridge", "vehicle": "v1", "preferred": 2}\n'
LEADER = '{"t_s": 1.0, "kind": "leader", "role": "bridge", "coordinator": "c0", "term": 1}\n'


def write(folder: Path, text: str | bytes) -> Path:
    content = text.encode() if isinstance(text, str) else text
    (folder / "events.jsonl").write_bytes(content)
    return folder


@pytest.mark.parametrize("end", ["", '{"t_s": 4.0, "ki', b'{"t_s": 4.0, "kind": "\xc3'])
def test_a_line_that_is_being_written_is_left_out(tmp_path: Path, end: str | bytes) -> None:
    last = end.encode() if isinstance(end, str) else end
    write(tmp_path, (ENTERED + LEADER).encode() + last)
    assert [event["kind"] for event in read_events(tmp_path)] == ["entered", "leader"]
    assert [event["t_s"] for event in read_events(tmp_path, "leader")] == [1.0]
    run = RecordedRun(tmp_path, make_summary(), Scenario())
    assert [event["kind"] for event in run.events()] == ["leader", "entered"]  # by time


@pytest.mark.parametrize(
    "damage",
    ['{"t_s": 4.0, "ki\n', "[1]", "{}\n", '{"t_s": "4", "kind": "left"}', '{"kind": "left"}'],
)
@pytest.mark.parametrize("place", ["first", "last"])
def test_damage_is_refused_with_the_name_of_the_file(
    tmp_path: Path, damage: str, place: str
) -> None:
    write(tmp_path, damage + "\n" * (damage[-1] != "\n") + ENTERED)
    if place == "last":
        write(tmp_path, ENTERED + damage)
    with pytest.raises(BadInputError, match=r"events\.jsonl"):
        list(read_events(tmp_path))
    with pytest.raises(BadInputError, match=r"^RUN: got .*events\.jsonl"):
        explain(tmp_path, "v1")


def test_old_recordings_have_no_events(tmp_path: Path) -> None:
    assert list(read_events(tmp_path)) == []
    with pytest.raises(BadInputError):
        list(read_events(tmp_path, required=True))
