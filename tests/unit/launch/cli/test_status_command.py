"""The table of `laneweave status`: one value in each row, no row for what was not seen."""

from __future__ import annotations

import io

from attrs import evolve
from rich.console import Console

from laneweave.launch.cli.status_command import show
from laneweave.launch.observe.findings import Finding
from laneweave.launch.observe.road_view import Coordinator, RoadView
from laneweave.launch.observe.status import Plans, Road, Status, status_of
from laneweave.protocol.wire.messages import Name

FINDINGS = [Finding("no-bridge", "bridge", "no bridge found", 1.0, "start the bridge")]


def shown(status: Status) -> dict[str, str]:
    """Return the printed rows."""
    stream = io.StringIO()
    show(status, Console(file=stream, width=100))
    rows = (line.split("  ", 1) for line in stream.getvalue().splitlines())
    return {name.strip(): value.strip() for name, value in rows}


def test_a_network_without_a_road() -> None:
    found = status_of(RoadView(), FINDINGS, 0.0, 2.0, 0.7, "tcp/127.0.0.1:7447", "test")
    rows = shown(found)
    assert rows == {
        "health": "not healthy",
        "bridge": "no bridge found",
        "realm": "test",
        "endpoint": "tcp/127.0.0.1:7447",
        "listened": "2.0 s",
        "leader": "none",
        "plans in force": "0",
        "road": "none",
    }


def test_a_deployment() -> None:
    empty = status_of(RoadView(), FINDINGS, 0.0, 2.0, 0.7, "tcp/127.0.0.1:7447", "test")
    first = Coordinator(Name("c1"), 1, True, 1, 3, 0.06, True)
    lost = Coordinator(Name("c2"), 1, False, None, None, None, True)
    road = Road(28.1, 2.0, 4.0, False, 25, 24, 4, 20)
    found = evolve(
        empty,
        leader="c1",
        term=1,
        claims=("c1", "c2"),
        candidates=(first, lost),
        plans=Plans(3, "formations", 5, 3),
        road=road,
        messages_per_s={"clock": 39.5},
    )
    rows = shown(found)
    assert rows["claim to lead"] == "c1, c2"
    assert rows["candidate c1"] == "term 1, heard 0.06 s ago, claims to lead"
    assert rows["candidate c2"] == "not heard from"
    assert rows["closed formations with a plan"] == "3 of 5"
    assert (rows["road"], rows["road time"], rows["pace"]) == ("advances", "28.1 s", "4.0")
    assert rows["clock messages"] == "39.5/s"
    ended = shown(evolve(found, road=evolve(road, ended=True)))
    assert ended["road"] == "ended"
    assert "pace" not in ended
