"""`laneweave explain`: the story and the reason, as text and as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from laneweave.launch.cli.explain_command import explain

EVENTS = [
    {"t_s": 0.8, "kind": "leader", "role": "bridge", "coordinator": "c1", "term": 1},
    {
        "t_s": 2.0,
        "kind": "entered",
        "role": "bridge",
        "vehicle": "v0001",
        "lane": 0,
        "preferred_lane": 2,
        "destination": "end",
    },
    {"t_s": 9.0, "kind": "caretaker-took-over", "role": "bridge", "vehicle": "v0001"}
    | {"reason": "absent"},
    {"t_s": 60.0, "kind": "left", "role": "bridge", "vehicle": "v0001", "lane": 0, "exit": "end"}
    | {"on_preferred_lane": False},
]
TEXT = "v0001 missed its goal (lane 2): no agent since 9.0 s: its agent is gone"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    lines = "".join(json.dumps(event) + "\n" for event in EVENTS)
    (tmp_path / "events.jsonl").write_text(lines, encoding="utf-8")
    return tmp_path


def test_the_last_line_is_the_reason(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    explain(folder, "v0001")
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert lines[-1] == TEXT
    assert lines[1:3] == [
        "2.0 s  entered in lane 0; wants lane 2",
        "9.0 s  caretaker in charge: its agent is gone",
    ]


def test_as_json(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    explain(folder, "v0001", as_json=True)
    found = json.loads(capsys.readouterr().out)
    assert (found["fate"], found["reason"], found["text"]) == ("missed", "no-agent", TEXT)
    assert found["story"][1] == {
        "t_s": 2.0,
        "kind": "entered",
        "text": "entered in lane 0; wants lane 2",
    }
