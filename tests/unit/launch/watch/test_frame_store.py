"""The part of the page that needs no browser, run by node."""

from __future__ import annotations

import json
from typing import Any

import attrs
import pytest

from laneweave.launch.watch.frames import Row, scene_of
from laneweave.launch.web import road_script, text_of
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import VehicleTypeSettings
from support.javascript import needs_node, printed_json

pytestmark = needs_node
PAGE = "laneweave.launch.watch"
BEGIN = "const store = new laneweaveFrames.FrameStore();"


def in_node(program: str, data: object = None) -> Any:  # noqa: ANN401 - any JSON
    """Return the result of a program, which can use `data` and the page's scripts."""
    scripts = [road_script(), *(text_of(PAGE, f"templates/{name}.js") for name in PARTS)]
    whole = "\n".join(scripts) + (
        "\nconst data = JSON.parse(require('fs').readFileSync(0));"
        f"\nconsole.log(JSON.stringify((() => {{ {program} }})()));"
    )
    return printed_json(whole, data)


PARTS = ("frames", "layers")


def scene(kind: str, first: int, last: int, session: str = "a") -> str:
    body = scene_of(Scenario(), kind, "here", 0.1)
    return json.dumps({"scene": body | {"first": first, "last": last, "session": session}})


def frame(number: int, t_s: float = 0.0, run: int = 1, vehicles: object = ()) -> str:
    return json.dumps({"n": number, "t": t_s, "run": run, "vehicles": vehicles})


def reel(first: int, last: int, begin: int, end: int) -> str:
    frames = [json.loads(frame(number)) for number in range(begin, end + 1)]
    return json.dumps({"reel": [begin, end], "first": first, "last": last, "frames": frames})


def test_frames_that_are_pushed_are_kept_and_bounded() -> None:
    messages = [scene("live", 0, -1), *(frame(number) for number in range(3100))]
    found = in_node(
        f"{BEGIN} for (const one of data) store.take(one);"
        "return [store.first, store.last, store.texts.size, store.newest.n, store.before.n,"
        " store.get(99), store.get(100).n];",
        messages,
    )
    assert found == [100, 3099, 3000, 3099, 3098, None, 100]


def test_missing_frames_are_requested_once() -> None:
    messages = [scene("recorded", 0, 500), reel(0, 500, 0, 49), reel(0, 500, 60, 70)]
    found = in_node(
        f"{BEGIN} store.take(data[0]);"
        "const requests = [store.missing(3.5, 10), store.missing(3.5, 10)];"
        "store.take(data[1]); requests.push(store.missing(3.5, 10), store.missing(45, 10));"
        "store.take(data[2]); requests.push(store.missing(60, 5), store.missing(499.5, 40));"
        "return requests;",
        messages,
    )
    assert found == [[3, 52], None, None, [50, 99], None, [499, 500]]


def test_another_server_has_other_frames() -> None:
    messages = [scene("live", 0, 9), frame(9), scene("live", 0, 12), scene("live", 0, 2, "b")]
    found = in_node(
        f"{BEGIN} return data.map((one) => {{ store.take(one);"
        " return [store.first, store.last, store.texts.size]; });",
        messages,
    )
    assert found == [[0, 9, 0], [0, 9, 1], [0, 12, 1], [0, 2, 0]]


def row(name: str, s_m: float, y_m: float, flags: int = 1) -> list[Any]:
    return [name, s_m, y_m, 15.0, 1, -1, [-3, 1], 0, flags, [-4, 1, -5, 1]]


def test_the_ending_of_a_run_is_no_frame() -> None:
    messages = [scene("live", 0, -1), frame(0), json.dumps({"end": "run ended"})]
    found = in_node(
        f"{BEGIN} const kinds = data.map((one) => store.take(one));"
        "return [kinds, store.end, store.newest.n, store.last];",
        messages,
    )
    assert found == [["scene", "frame", "end"], "run ended", 0, 0]


def test_vehicles_are_interpolated_between_frames() -> None:
    one = json.loads(frame(1, 10.0, vehicles=[row("a", 100.0, 5.0), row("gone", 999.0, 5.0)]))
    two = json.loads(frame(2, 10.2, vehicles=[row("a", 103.0, 5.3), row("new", 0.0, 5.0)]))
    between = "return laneweaveFrames.between(data[0], data[1], 0.5);"
    shown = in_node(between, [one, two])
    assert shown["t"] == pytest.approx(10.1)
    assert [body["name"] for body in shown["bodies"]] == ["a", "new"]
    body = shown["bodies"][0]
    assert (body["s"], body["y"], body["slope"]) == pytest.approx((101.5, 5.15, 0.25 / 3.0))
    assert (body["hold"], body["target"], body["owned"]) == ([-3, 1], None, [[-4, 1], [-5, 1]])
    # Measurement errors do not rotate a vehicle that drives straight on. Positions are not
    # interpolated over jumps, and not between runs.
    two["vehicles"][0][8] = 0
    assert in_node(between, [one, two])["bodies"][0]["slope"] == 0
    two["vehicles"][0][1] = 500.0
    assert in_node(between, [one, two])["bodies"][0]["s"] == 500.0
    other = json.loads(frame(2, 0.1, run=2, vehicles=[row("a", 5.0, 5.3)]))
    assert in_node(between, [one, other])["bodies"][0]["s"] == 100.0
    assert in_node(between, [one, None])["t"] == 10.0


def test_formations_that_plan_together_are_one() -> None:
    formations = [[12, -15, -12], [7, -11, -7], [3, -6, -4], [0, -2, 0]]
    found = in_node("return laneweaveLayers.groups(data, [[7, 12], [20, 21]]);", formations)
    assert [(one["numbers"], one["rear"], one["front"]) for one in found] == [
        ([0], -2, 0),
        ([3], -6, -4),
        ([7, 12], -15, -7),
    ]


def test_bodies_have_the_sizes_of_their_types() -> None:
    truck = VehicleTypeSettings("truck", 0.2, length_m=12.0, width_m=2.5)
    scenario = attrs.evolve(Scenario(), vehicle_type=(truck,))
    rows = [
        Row("a", 1.0, 2.0, 15.0, -1, -1, None, None, 0).compact(),
        Row("b", 1.0, 2.0, 15.0, -1, -1, None, None, 0, vehicle_type="truck").compact(),
    ]
    data = {"scene": scene_of(scenario, "live", "here", 0.1), "frame": json.loads(frame(1))}
    data["frame"]["vehicles"] = rows
    found = in_node(
        "const shown = laneweaveFrames.between(data.frame, null, 0).bodies;"
        "return shown.map((body) => laneweaveRoad.sizeOf(data.scene, body));",
        data,
    )
    assert found == [[5.0, 1.8], [12.0, 2.5]]


def test_numbers_beside_the_road() -> None:
    bodies = [
        {"lane": 1, "y": 5.0, "v": 10.0, "faint": False},
        {"lane": 0, "y": 5.0, "v": 20.0, "faint": False},
        {"lane": -1, "y": 5.0, "v": 99.0, "faint": True},
    ]
    data = {"scene": {"road": {"lane_width_m": 3.5}}, "bodies": bodies}
    found = in_node("return laneweaveFrames.facts(data.scene, data.bodies);", data)
    assert found == {"inLane": 1, "knownLane": 2, "speed": 15.0}
