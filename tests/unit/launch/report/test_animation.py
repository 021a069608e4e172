"""The moving road: the data decode to the trajectories, in Python and in the page's own script."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from laneweave.launch.drawing.colours import lane_colours, text_colour
from laneweave.launch.recordings.runs import Run, single_run
from laneweave.launch.recordings.trajectories import Tracks, read_tracks
from laneweave.launch.report import animation
from laneweave.launch.report.animation import KINDS, animation_data
from laneweave.launch.report.snapshots import _shade
from laneweave.launch.web import road_script
from support.javascript import needs_node, printed_json
from support.tracks import make_tracks

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(swept: Path) -> Run:
    return single_run(swept / "formation-1600-1")


@pytest.fixture(scope="module")
def tracks(run: Run) -> Tracks:
    return read_tracks(run.folder)


def column(data: dict[str, Any], name: str) -> NDArray[np.float64]:
    raw = base64.b64decode(data["columns"][name], validate=True)
    return np.frombuffer(raw, KINDS[name]) * float(data["units"][name])


def test_data_decode_to_the_trajectories(run: Run, tracks: Tracks) -> None:
    data = json.loads(json.dumps(animation_data(run, tracks)))
    assert sorted(vehicle["name"] for vehicle in data["vehicles"]) == sorted(tracks.names)
    decoded = {name: column(data, name) for name in KINDS}
    offset = 0
    for vehicle in data["vehicles"]:
        rows = tracks.rows(tracks.names.index(vehicle["name"]))
        times_s = data["step_s"] * (vehicle["first"] + np.arange(vehicle["count"]))
        assert times_s[0] - tracks.t_s[rows][0] < data["step_s"]
        assert tracks.t_s[rows][-1] - times_s[-1] < data["step_s"]
        for name, values in decoded.items():
            expected = np.interp(times_s, tracks.t_s[rows], getattr(tracks, name)[rows])
            found = values[offset : offset + vehicle["count"]]
            assert np.abs(found - expected).max() <= 0.501 * data["units"][name]
        offset += vehicle["count"]
    assert {len(values) for values in decoded.values()} == {offset}
    # Finer than a pixel of the player.
    assert data["units"]["s_m"] <= 0.05
    assert data["units"]["y_m"] <= 0.001


def test_long_runs_are_sampled_more_coarsely_and_then_cut(
    run: Run, tracks: Tracks, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples = len(tracks.t_s) * run.scenario.runtime.tick_s
    for most, step_s in ((samples / 0.5 + 200, 0.5), (samples / 4, 1.0)):
        monkeypatch.setattr(animation, "MAX_SAMPLES", most)
        data = animation_data(run, tracks)
        assert data["step_s"] == step_s
        assert len(column(data, "s_m")) <= most
    assert data["end_s"] < float(tracks.t_s.max())
    assert len(data["vehicles"]) < len(tracks.names)


def test_a_run_without_vehicles(run: Run) -> None:
    data = animation_data(run, make_tracks(np.empty(0), 0))
    assert (data["vehicles"], data["columns"]["s_m"], data["end_s"]) == ([], "", 0.0)


def in_node(expression: str, data: dict[str, Any]) -> Any:  # noqa: ANN401 - any JSON
    """Return the value of an expression in which `run` is the decoded data."""
    player = (files("laneweave.launch.report") / "templates" / "player.js").read_text("utf-8")
    script = road_script() + player
    program = (
        f"{script}\nconst run = laneweave.decode(JSON.parse(require('fs').readFileSync(0)));\n"
        f"console.log(JSON.stringify({expression}));"
    )
    return printed_json(program, data)


@needs_node
def test_the_player_shows_the_recorded_positions(run: Run, tracks: Tracks) -> None:
    data = animation_data(run, tracks)
    times_s = [0.0, 7.3, 21.05, 33.33, data["end_s"], data["end_s"] + 5.0]
    expression = (
        f"{json.dumps(times_s)}.map((t) => "
        "laneweave.allAt(run, t).map(([vehicle, state]) => [vehicle.name, state]))"
    )
    seen = 0
    for t_s, shown in zip(times_s, in_node(expression, data), strict=True):
        found = dict(shown)
        for number, name in enumerate(tracks.names):
            rows = tracks.rows(number)
            first_s, last_s = tracks.t_s[rows][0], tracks.t_s[rows][-1]
            if first_s + 0.2 <= t_s <= last_s - 0.2:
                assert name in found
            if t_s < first_s - 1e-6 or t_s > last_s + 1e-6:
                assert name not in found
            if name in found:
                seen += 1
                near = {
                    key: float(np.interp(t_s, tracks.t_s[rows], getattr(tracks, key)[rows]))
                    for key in KINDS
                }
                assert found[name]["s"] == pytest.approx(near["s_m"], abs=0.06)
                assert found[name]["y"] == pytest.approx(near["y_m"], abs=0.03)
                assert found[name]["v"] == pytest.approx(near["speed_mps"], abs=0.2)
    assert seen > 20


@needs_node
@pytest.mark.parametrize("longer", [False, True], ids=["blocks", "lengths"])
def test_the_player_follows_formations(run: Run, tracks: Tracks, *, longer: bool) -> None:
    data = animation_data(run, tracks)
    lattice = run.scenario.lattice
    assert data["formations"][:2] == [[0, -3, 0], [1, -7, -4]]
    if longer:
        data["formations"] = [[0, -4, 0], [1, -7, -5], *data["formations"][2:]]
    centres = in_node("[0, 1].map((f) => laneweave.formationCentre(run, f, 20))", data)
    for (_, rear, front), centre_m in zip(data["formations"][:2], centres, strict=True):
        rear_m = lattice.cell_s_m(rear, 20.0) - run.scenario.vehicle.length_m
        assert centre_m == pytest.approx(0.5 * (rear_m + lattice.cell_s_m(front, 20.0)))


@needs_node
def test_the_player_offers_what_is_on_the_road(run: Run, tracks: Tracks) -> None:
    data = animation_data(run, tracks)
    for t_s in (10.0, 30.0):
        names = in_node(f"laneweave.followable(run, {t_s}).map((one) => one.name)", data)
        present = {
            name
            for number, name in enumerate(tracks.names)
            if tracks.t_s[tracks.rows(number)][0] <= t_s <= tracks.t_s[tracks.rows(number)][-1]
        }
        formations = [name for name in names if name.startswith("formation ")]
        assert set(names) - set(formations) == present
        assert len(names) == len(set(names))
        known = {one["name"]: one["formation"] for one in data["vehicles"]}
        expected = {f"formation {known[name]}" for name in present if known[name] is not None}
        assert set(formations) == expected


@needs_node
def test_the_player_shows_the_whole_road_or_a_window_on_it(run: Run, tracks: Tracks) -> None:
    data = animation_data(run, tracks)
    length_m = run.scenario.road.length_m
    expression = (
        "[laneweave.stretches(run, null, 5, 240),"
        " ...[0, 15, 500].map((t) => laneweave.stretches(run, {formation: 0}, t, 240)[0]),"
        " laneweave.stretches(run, {vehicle: run.vehicles[0]}, 500, 240)[0]]"
    )
    whole, *windows = in_node(expression, data)
    assert whole[0][0] == 0.0
    assert whole[-1][1] == length_m
    for begin_m, end_m in windows:
        assert end_m - begin_m == 80.0  # 3 px/m
        assert 0.0 <= begin_m < end_m <= length_m
    assert windows[0][0] == 0.0
    assert windows[2] == windows[3] == [length_m - 80.0, length_m]


@needs_node
def test_the_player_colours_as_the_pictures_do(run: Run, tracks: Tracks) -> None:
    data = animation_data(run, tracks)
    speeds, shade = (-9.0, -2.5, 0.0, 1.0, 7.0), data["shade"]
    colours = (*lane_colours(3), *lane_colours(8))
    shades, texts, stretches = in_node(
        f"[{json.dumps(speeds)}.map((over) => laneweaveRoad.shade("
        f"'#2f6fc4', over, {shade['span_mps']}, {shade['strength']})),"
        f" {json.dumps([rgb(colour) for colour in colours])}.map(laneweaveRoad.textColour),"
        " [1200, 380, 60].map((width) => laneweaveRoad.wholeRoad(1000, width))]",
        data,
    )
    for over_mps, shown in zip(speeds, shades, strict=True):
        assert shown == f"rgb({','.join(str(round(255 * x)) for x in _shade('#2f6fc4', over_mps))})"
    assert texts == list(map(text_colour, colours))
    # Narrow pages show more stretches.
    assert [len(one) for one in stretches] == [4, 8, 16]
    for found in stretches:
        assert [begin for begin, _ in found[1:]] == [end for _, end in found[:-1]]


def rgb(colour: str) -> str:
    return f"rgb({','.join(str(int(colour[place : place + 2], 16)) for place in (1, 3, 5))})"
