"""Closed parts of lanes: what figures and pages show of them, and how the pages draw them."""

from __future__ import annotations

from typing import Any

import pytest
from attrs import evolve

from laneweave.launch.drawing.colours import NEUTRAL, lane_colours, vehicle_colour, vehicle_legend
from laneweave.launch.drawing.road_scene import (
    ClosedPart,
    closed_parts,
    closed_parts_script,
    describe_closed_parts,
    road_scene,
)
from laneweave.launch.web import road_script
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Closure
from laneweave.protocol.vehicle.re_entry import re_entry
from support.closed_lanes import BLOCKED, DROP, DROP_M
from support.javascript import needs_node, printed_json
from support.tables import for_each

ROOM_M = re_entry(DROP).room_m


def five_lanes(*closures: Closure) -> Scenario:
    return evolve(DROP, road=evolve(DROP.road, lanes=5, closures=closures))


def test_closed_parts_are_sorted_and_end_with_the_road() -> None:
    assert closed_parts(DROP) == (ClosedPart(0, DROP_M, 1000.0, DROP_M - ROOM_M),)
    assert closed_parts(BLOCKED) == (ClosedPart(1, 600.0, 700.0, 600.0 - ROOM_M),)
    assert closed_parts(Scenario()) == ()
    scenario = five_lanes(Closure(4, 700.0), Closure(0, 800.0), Closure(0, 300.0, 400.0))
    found = [(part.lane, part.from_m, part.to_m) for part in closed_parts(scenario)]
    assert found == [(0, 300.0, 400.0), (0, 800.0, 1000.0), (4, 700.0, 1000.0)]


@for_each(
    ("scenario", "sentences"),
    [
        (Scenario(), ""),
        (DROP, "The right lane is closed from 800 m to the end of the road."),
        (BLOCKED, "The middle lane is closed from 600 m to 700 m."),
        (
            five_lanes(Closure(0, 800.0), Closure(1, 650.5, 700.0)),
            (
                "Lane 0 (0: rightmost) is closed from 800 m to the end of the road. "
                "Lane 1 (0: rightmost) is closed from 650.5 m to 700 m."
            ),
        ),
    ],
)
def test_closed_parts_in_words(scenario: Scenario, sentences: str) -> None:
    assert describe_closed_parts(scenario) == sentences


def test_vehicles_without_a_preferred_lane_have_a_neutral_colour() -> None:
    for lanes in range(1, 9):
        assert vehicle_colour(lanes, ANY_LANE) == NEUTRAL
        assert NEUTRAL not in lane_colours(lanes)
        assert [vehicle_colour(lanes, lane) for lane in range(lanes)] == list(lane_colours(lanes))
    # The pages draw vehicles whose lane is unknown in the same colour.
    assert f'"{NEUTRAL}"' in road_script()


def test_the_legend_of_vehicles() -> None:
    assert vehicle_legend(DROP) == ((NEUTRAL, "no preferred lane"),)
    shares = evolve(DROP, demand=evolve(DROP.demand, lane_shares=(0.0, 1.0, 1.0)))
    for scenario in (Scenario(), shares):
        meanings = [words for _, words in vehicle_legend(scenario)]
        assert meanings == ["2: prefers left", "1: prefers middle", "0: prefers right"]
        assert [colour for colour, _ in vehicle_legend(scenario)][::-1] == list(lane_colours(3))


def test_the_scene_contains_closed_parts_and_stop_lines() -> None:
    scene = road_scene(BLOCKED)
    assert scene["road"]["closed"] == [[1, 600.0, 700.0]]
    assert scene["road"]["stop_lines"] == [[1, 600.0 - ROOM_M]]
    assert (scene["preferences"], road_scene(Scenario())["preferences"]) == (False, True)
    assert road_scene(Scenario())["road"]["closed"] == []


RECORD = """
const calls = [];
const pen = new Proxy({}, {
  get: (_, name) => (...values) => calls.push([name, ...values]),
  set: () => true,
});
const painter = Object.create(laneweaveRoad.Painter.prototype);
Object.assign(painter, { scene: data, theme: laneweaveRoad.LIGHT, pen, scale: 2, roadPx: 37.8 });
const drawn = [[500, 750], [750, 1000], [640, 660]].map(([from, to]) => {
  calls.length = 0;
  Object.assign(painter, { from, to, width: 2 * (to - from) });
  laneweaveClosed.closedParts(painter);
  return calls.filter(([name]) => ["fillRect", "moveTo"].includes(name));
});
console.log(JSON.stringify(drawn));
"""


def drawn(scenario: Scenario) -> list[list[list[Any]]]:
    """Return the rectangles and starts of lines on three stretches, at 2 pixels per metre."""
    scripts = [road_script(), closed_parts_script()]
    program = "\n".join([*scripts, "const data = JSON.parse(require('fs').readFileSync(0));"])
    found: list[list[list[Any]]] = printed_json(program + RECORD, road_scene(scenario))
    return found


def rectangles(calls: list[list[Any]]) -> set[tuple[float, ...]]:
    """Return (x, y, width, height) of the filled rectangles."""
    return {tuple(round(value, 6) for value in call[1:]) for call in calls if "fillRect" in call}


@needs_node
def test_the_pages_draw_closed_parts_on_the_canvas_only() -> None:
    # Lanes are 12.6 pixels wide; lane 0 is at the bottom.
    before, after, inside = drawn(DROP)
    assert rectangles(before) == rectangles(inside) == set()
    assert rectangles(after) == {(100.0, 25.2, 400.0, 12.6)}
    whole, beyond, inside = drawn(BLOCKED)
    assert rectangles(whole) == {(200.0, 12.6, 200.0, 12.6)}
    assert rectangles(beyond) == set()
    assert rectangles(inside) == {(0.0, 12.6, 40.0, 12.6)}
    assert 5 < len(inside) < 20  # lines that are visible


LABELS = """
const calls = [];
const pen = new Proxy({}, {
  get: (_, name) => name === "measureText"
    ? (text) => ({ width: 6 * text.length })
    : (...values) => calls.push([name, ...values]),
  set: () => true,
});
const canvas = { clientWidth: data.width, style: {}, getContext: () => pen };
globalThis.window = { devicePixelRatio: 1 };
const painter = new laneweaveRoad.Painter(canvas, data.scene);
const body = { name: "v1", lane: 0, s: 600, y: 1.75, v: 15, slope: 0, type: "car" };
const bodies = [body, { ...body, name: "v2", s: 700 }];
painter.paint(laneweaveRoad.wholeRoad(1000, data.width), bodies, [], "v2");
const shown = ["fillText", "roundRect", "translate"];
console.log(JSON.stringify(calls.filter(([name]) => shown.includes(name))));
"""


def painted(width_px: int) -> list[list[Any]]:
    """Return texts, rings and starts of stretches of a road with two vehicles, one followed."""
    program = road_script() + "\nconst data = JSON.parse(require('fs').readFileSync(0));" + LABELS
    scene = {"scene": road_scene(Scenario()), "width": width_px}
    found: list[list[Any]] = printed_json(program, scene)
    return found


@needs_node
@for_each("width_px", [320, 396, 900])
def test_labels_of_the_scale_do_not_touch(width_px: int) -> None:
    stretches: list[list[tuple[float, str]]] = []
    for name, *values in painted(width_px):
        if name == "translate":
            stretches.append([])
        elif name == "fillText" and str(values[0]).endswith(" m"):
            stretches[-1].append((values[1], values[0]))
    assert len(stretches) >= 4
    for labels in stretches:
        assert len(labels) >= 2
        ends_px = [0.0] + [left + 6 * len(text) for left, text in labels]
        assert all(left >= end for end, (left, _) in zip(ends_px, labels, strict=False))
        assert ends_px[-1] <= width_px


@needs_node
def test_the_followed_vehicle_has_a_ring_and_a_name() -> None:
    calls = painted(1280)
    ring = [name for name, *_ in calls].index("roundRect")
    texts = [values[0] for name, *values in calls if name == "fillText"]
    assert "v2" in texts[: ring + 1]
    assert "v1" not in texts  # names of all vehicles need more room
    assert sum(name == "roundRect" for name, *_ in calls) == 2  # with its light edge


@needs_node
def test_the_pages_draw_stop_lines() -> None:
    assert DROP_M - ROOM_M == 750.0
    lines = [[call for call in calls if call[0] == "moveTo"][-1:] for calls in drawn(DROP)]
    # At the border between two stretches, the line is on the canvas of both.
    (before, *_), (after, *_), inside = lines
    assert before[1:] == pytest.approx([498.5, 25.2])
    assert after[1:] == pytest.approx([1.5, 25.2])
    assert inside == []
