"""Counts over trajectories, and formations' path maps as they were driven."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from attrs import evolve
from numpy.typing import ArrayLike

from laneweave.launch.drawing.figures import new_figure
from laneweave.launch.recordings.events import read_events
from laneweave.launch.recordings.runs import Run, single_run
from laneweave.launch.recordings.trajectories import Tracks, read_tracks
from laneweave.launch.report.distributions import (
    DECELERATION,
    HEADWAY,
    JERK,
    LATERAL,
    SPACING,
    Counts,
    Quantity,
    _explain_missing,
    count,
)
from laneweave.launch.report.figures import _break
from laneweave.launch.report.path_maps import _arrived, driven_map
from laneweave.launch.report.style import label_colours, label_widths, spread_evenly
from laneweave.launch.run_methods import METHODS
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from support.closed_lanes import BLOCKED
from support.older_recordings import older_recording
from support.tracks import make_tracks

T_S = 0.1 * np.arange(101)
SHORT = load_scenario(None, demand__duration_s=10.0)


def tracks(*vehicles: Sequence[ArrayLike]) -> Tracks:
    """Return tracks of 10 s from (s m, y m, speed m/s, acceleration m/s2) of each vehicle."""
    names = ("s_m", "y_m", "speed_mps", "accel_mps2")
    columns = dict(zip(names, zip(*vehicles, strict=True), strict=True))
    return make_tracks(T_S, len(vehicles), **columns)


def centres(counts: Counts, quantity: Quantity) -> list[float]:
    """Return the middles of the bins that are not empty."""
    middles = 0.5 * (quantity.edges[1:] + quantity.edges[:-1])
    return [round(float(one), 3) for one in middles[counts.of[quantity.name] > 0]]


def test_vehicles_arrive_in_lanes_by_which_they_may_leave() -> None:
    path = ((0, 0), (0, 0), (0, 1))
    times_s = np.array([0.0, 20.0, 60.0])
    # Lane 1 is closed from 600 to 700 m: cells of lane 1 at 0, 300 and 900 m; lane 0 is open.
    cells = tuple((column, 1 - lane) for column, lane in path)
    assert _arrived(BLOCKED, ANY_LANE, path, 0, times_s) == (True, True, True)
    assert _arrived(BLOCKED, ANY_LANE, cells, 0, times_s) == (False, False, True)
    assert _arrived(BLOCKED, 1, path, 0, times_s) == (False, False, True)
    assert _arrived(Scenario(), 1, path, 0, times_s) == (False, False, True)
    assert _arrived(Scenario(), 0, path, 0, times_s) == (True, True, False)


def test_spacings_are_those_to_the_next_ahead_on_the_lane() -> None:
    s_m = 10.0 * T_S
    counts = count(
        tracks(
            (s_m, 1.75, 10.0, 0.0),
            (s_m + 40.0, 1.75, 20.0, 0.0),
            (s_m + 30.0, 5.25, 10.0, 0.0),  # the other lane
            (s_m + 60.0, 1.0, 0.0, 0.0),  # beside the centre
        ),
        SHORT,
    )
    assert centres(counts, SPACING) == [20.0, 40.0]
    assert centres(counts, HEADWAY) == [1.0, 4.0]
    assert counts.of["spacing"].sum() == 2 * 11
    np.testing.assert_allclose(counts.cumulative(SPACING)[[38, 40, 78, 80]], [0, 0.5, 0.5, 1.0])


def test_decelerations_jerks_and_lateral_accelerations() -> None:
    accel_mps2 = np.where(T_S < 5.0, -2.02, 0.0)
    counts = count(tracks((0.0, 0.5 * 1.01 * T_S**2, 10.0, accel_mps2)), SHORT)
    assert counts.exceedance(DECELERATION)[40] == pytest.approx(50 / 101)
    assert counts.exceedance(DECELERATION)[41] == 0.0
    assert counts.of[JERK.name][-1] == 1
    assert counts.of[JERK.name][0] == 99
    assert centres(counts, LATERAL) == pytest.approx([1.0125], abs=1e-3)


def test_instantaneous_lane_changes_have_no_lateral_acceleration() -> None:
    y_m = np.where(T_S < 5.0, 1.75, 5.25)
    counts = count(tracks((0.0, y_m, 10.0, 0.0)), SHORT)
    assert centres(counts, LATERAL) == [0.013]  # the first bin
    assert counts.of[LATERAL.name].sum() == 99 - 2  # without the two differences over the change


def test_only_steady_traffic_is_counted_where_there_is_some() -> None:
    late = tracks((0.0, 1.75, 10.0, 0.0))
    scenario = load_scenario(None, demand__duration_s=80.0)
    assert count(late, scenario).of[DECELERATION.name].sum() == 0
    assert count(late, load_scenario(None, demand__duration_s=65.0)).of["deceleration"].sum() == 101


def test_panels_say_which_labels_have_no_curve() -> None:
    figure = new_figure(4.0, 3.0)
    still = count(tracks((0.0, 1.75, 10.0, 0.0)), SHORT)
    braking = count(tracks((0.0, 1.75, 10.0, -1.0)), SHORT)
    for counted, said in (
        ({("a", 1.0): still}, "no values above 0"),
        ({("a", 1.0): still, ("b", 1.0): braking}, "no values above 0:\na"),
        ({("b", 1.0): braking}, None),
        ({("a", 2.0): still}, "no trajectories"),
    ):
        axes = figure.add_subplot()
        _explain_missing(axes, counted, DECELERATION, 1.0, ["a", "b"])
        assert [text.get_text() for text in axes.texts] == [said] * (said is not None)
    axes = figure.add_subplot()
    _explain_missing(axes, {("a", 1.0): still}, SPACING, 1.0, ["a"])
    assert axes.texts[0].get_text() == "no vehicle follows another"


def test_counts_add_up() -> None:
    one = count(tracks((0.0, 1.75, 10.0, -1.0)), SHORT)
    both = Counts() + one + one
    assert both.of[DECELERATION.name].sum() == 202
    np.testing.assert_array_equal(both.exceedance(DECELERATION), one.exceedance(DECELERATION))


@pytest.mark.slow
def test_path_maps_are_those_of_the_driven_plans(swept: Path) -> None:
    run = single_run(swept / "formation-1600-1")
    driven_tracks = read_tracks(run.folder)
    trips = {row["vehicle"]: row for row in pq.read_table(run.folder / "trips.parquet").to_pylist()}
    formations = sorted({trip["formation"] for trip in trips.values()})
    plans = {event["formation"]: event for event in read_events(run.folder, "plan-made")}
    moved = 0
    for formation in formations:
        driven = driven_map(run, driven_tracks, formation)
        assert driven is not None
        path_map = driven.path_map
        moved += path_map.cost()
        if formation in plans:
            plan = plans[formation]
            assert (driven.start_s, driven.slot_s) == (plan["t0_s"], plan["slot_s"])
            assert path_map.cost() == plan["cost"]
        members = {name for name, trip in trips.items() if trip["formation"] == formation}
        assert set(path_map.ids) == members
        for name, row, lane in zip(
            path_map.ids, path_map.rows, driven.preferred_lanes, strict=True
        ):
            assert row[0][1] == trips[name]["arrival_lane"]
            if driven.start_s + path_map.steps * driven.slot_s < trips[name]["left_s"]:
                assert row[-1][1] == trips[name]["final_lane"]
            assert lane == trips[name]["preferred_lane"]
            assert all(0 <= column < 4 for column, _ in row)
            for (column, lane_a), (next_column, lane_b) in pairwise(row):
                assert abs(next_column - column) + abs(lane_b - lane_a) <= 1
        for cells in zip(*path_map.rows, strict=True):
            assert len(set(cells)) == len(cells)
    assert moved > 10
    most = driven_map(run, driven_tracks, None)
    assert most is not None
    with pytest.raises(BadInputError, match="--formation: got -1"):
        driven_map(run, driven_tracks, -1)


def formations_of_two_lengths(folder: Path) -> tuple[Run, Tracks]:
    """Return a recording of two formations: columns 0 to -2, and columns -3 to -7.

    In each two vehicles change places: one leaves its column, then both change lanes.
    """
    cells = {
        # Slots of 5 s from 20 s on.
        "a": (0, [(0, 0), (0, 0), (0, 1)], 20.0, 5.0),
        "b": (0, [(-1, 1), (-2, 1), (-2, 0)], 20.0, 5.0),
        # Slots of 6.2 s from 30 s on.
        "c": (3, [(-3, 0), (-3, 0), (-3, 1)], 30.0, 6.2),
        "d": (3, [(-7, 1), (-6, 1), (-6, 0)], 30.0, 6.2),
    }
    t_s = 0.1 * np.arange(600)
    columns, lanes = [], []
    for _, path, start_s, slot_s in cells.values():
        slot = np.clip(np.floor((t_s - start_s) / slot_s + 1e-6) + 1, 0, 2).astype(int)
        columns.append(np.array([column for column, _ in path])[slot])
        lanes.append(np.array([lane for _, lane in path])[slot])
    driven = evolve(
        make_tracks(t_s, 4, reserved_column=columns, reserved_lane=lanes), names=tuple(cells)
    )
    trips = {
        "vehicle": list(cells),
        "preferred_lane": [path[-1][1] for _, path, _, _ in cells.values()],
        "formation": [number for number, *_ in cells.values()],
    }
    pq.write_table(pa.table(trips), folder / "trips.parquet")
    closed = [(0, [-2, 0]), (3, [-7, -3])]
    plans = [(0, 8.0, 4.0), (0, 20.0, 5.0), (0, 90.0, 7.0), (3, 30.0, 6.2)]
    events = [
        *({"kind": "formation-closed", "formation": n, "columns": c} for n, c in closed),
        *({"kind": "plan-made", "formation": n, "t0_s": t, "slot_s": s} for n, t, s in plans),
    ]
    with (folder / "events.jsonl").open("w") as lines:
        for event in events:
            role = "bridge" if event["kind"] == "formation-closed" else "coordinator"
            lines.write(json.dumps({"t_s": 5.0, "role": role} | event) + "\n")
        # Who is no bridge says nothing about formations.
        forged = {"kind": "formation-closed", "formation": 0, "columns": [-9, 0]}
        lines.write(json.dumps({"t_s": 5.0, "role": "agent"} | forged) + "\n")
    return Run(folder, "formation", "formation", load_scenario(None), None), driven


def test_path_maps_of_formations_of_different_lengths(tmp_path: Path) -> None:
    run, driven_tracks = formations_of_two_lengths(tmp_path)
    short, long = (driven_map(run, driven_tracks, number) for number in (0, 3))
    assert short is not None
    assert long is not None
    # The last plan of which a move was driven says when slots begin, and how long they are.
    assert (short.start_s, short.slot_s) == (20.0, 5.0)
    assert (long.start_s, long.slot_s) == (30.0, 6.2)
    # Columns count from the formation's own rear: three of them, and five.
    assert short.path_map.rows == (((2, 0), (2, 0), (2, 1)), ((1, 1), (0, 1), (0, 0)))
    assert long.path_map.rows == (((4, 0), (4, 0), (4, 1)), ((0, 1), (1, 1), (1, 0)))
    with pytest.raises(BadInputError, match=r"--formation: got 2; allowed: .*: 0, 3$"):
        driven_map(run, driven_tracks, 2)


@pytest.mark.slow
def test_the_path_map_of_an_older_recording(swept: Path, tmp_path: Path) -> None:
    newer = single_run(swept / "formation-1600-1")
    older = single_run(older_recording(newer.folder, tmp_path / "run"))
    shown = driven_map(older, read_tracks(older.folder), 2)
    expected = driven_map(newer, read_tracks(newer.folder), 2)
    assert shown is not None
    assert expected is not None
    assert shown.path_map.ids == expected.path_map.ids
    assert [row[-1] for row in shown.path_map.rows] == [
        row[-1] for row in expected.path_map.rows
    ]  # fmt: skip
    assert shown.path_map.cost() <= expected.path_map.cost()
    assert shown.slot_s == 4.0


def test_styles_of_labels_and_volumes() -> None:
    several = label_colours(["formation", "paper-12", "mine", "yours"])
    assert several["paper-12"] == label_colours(["paper-12"])["paper-12"]
    assert len(set(several.values())) == 4
    others = label_colours([*METHODS, "mine", "yours"])
    assert not {"#808890", "#7d3600"} & {others["mine"], others["yours"]}  # grey, brown
    widths = list(label_widths(["formation", "rolling", "rule"]).values())
    assert widths == sorted(set(widths), reverse=True)
    assert spread_evenly([1.0, 2.0]) == (1.0, 2.0)
    assert spread_evenly(list(map(float, range(11)))) == (0.0, 2.0, 4.0, 6.0, 8.0, 10.0)


def test_the_axis_of_travel_times_is_broken_where_a_method_jams() -> None:
    calm, slower = np.linspace(66.0, 70.0, 101), np.linspace(67.0, 76.0, 101)
    jam = np.linspace(90.0, 300.0, 101)
    assert _break([calm, slower, np.empty(0)]) is None
    broken_s = _break([calm, slower, jam])
    assert broken_s is not None
    assert 76.0 <= broken_s <= 1.25 * 68.0
    # A few very late vehicles do not stretch the part below the break.
    late = np.concatenate([slower, [200.0] * 5])
    assert _break([calm, late, jam]) == pytest.approx(1.25 * 68.0)
    assert _break([]) is None
