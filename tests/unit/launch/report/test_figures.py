"""Pictures are drawn from any run's files, short and empty ones included."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from attrs import evolve
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from PIL import Image

from laneweave.launch.drawing.colours import CLOSED_FILL, NEUTRAL, lane_colours
from laneweave.launch.drawing.figures import FigureFormat
from laneweave.launch.recordings.runs import Comparison, Run, scenario_of
from laneweave.launch.report.figures import (
    MeanSpeeds,
    draw_flows,
    draw_speeds,
    draw_travel_times,
    shares_differ,
    speed_scale,
)
from laneweave.launch.report.report import TOO_SHORT, report_comparison, report_run
from laneweave.launch.report.snapshots import (
    _MAX_HEADING,
    _pose,
    changes_gradually,
    default_stretch_m,
    road_snapshots,
)
from laneweave.launch.report.style import legend_above, picture
from laneweave.launch.report.summary_table import summary_rows
from laneweave.launch.report.tables import run_table, tables_of
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Closure
from laneweave.sim_bridge.recording.trips import Trip
from laneweave.sim_bridge.road.demand import Arrival
from support.closed_lanes import DROP
from support.commands import loads
from support.straight_runs import make_run, record
from support.summaries import make_summary
from support.tables import for_each
from support.tracks import make_tracks
from support.variants import variants


def is_picture(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 2000


def comparison(*folders: Path) -> Comparison:
    return Comparison.of(
        Run(folder, folder.name, "formation", scenario_of(folder / "trips.parquet"), None)
        for folder in folders
    )


def draw_all(folder: Path) -> None:
    runs = comparison(folder)
    draw_travel_times(runs, folder / "box.png", dpi=60)
    draw_speeds(runs, folder / "heat.png", dpi=60)
    road_snapshots(folder, folder / "road.png", dpi=60)
    assert all(is_picture(folder / name) for name in ("box.png", "heat.png", "road.png"))


@pytest.mark.slow
@pytest.mark.parametrize("lanes", variants([2, 1, 3, 5]))
def test_pictures_of_any_number_of_lanes(tmp_path: Path, lanes: int) -> None:
    draw_all(make_run(tmp_path, lanes, lattice=lanes != 2))


def test_pictures_of_an_empty_run(tmp_path: Path) -> None:
    record(tmp_path, parse_scenario({}), ())
    draw_all(tmp_path)


def make_run_without_preferences(folder: Path) -> Path:
    """Record vehicles that drive straight on in two lanes, beside a lane that ends."""
    trips = [
        Trip(
            Arrival(f"v{n}", 1 + n % 2, ANY_LANE, 55.0 + n), 55.5 + n, 122.2 + n, n // 6, 1 + n % 2
        )
        for n in range(12)
    ]
    record(folder, DROP, trips)
    return folder


def colours_of(path: Path) -> set[tuple[int, ...]]:
    """Return the colours of at least a few pixels of a picture."""
    with Image.open(path) as image:
        found = image.convert("RGB").getcolors(maxcolors=1 << 24) or []
    return {colour for count, colour in found if count > 5 and isinstance(colour, tuple)}


def rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour[1:]))


def test_pictures_show_closed_parts_and_vehicles_without_preferences(tmp_path: Path) -> None:
    folder = make_run_without_preferences(tmp_path)
    draw_all(folder)
    road_snapshots(folder, folder / "road.png", times=[90.0, 100.0, 110.0], dpi=150)
    shown = colours_of(folder / "road.png")
    # Vehicles have the colours of the lanes in which they arrived.
    assert {rgb(CLOSED_FILL), *map(rgb, lane_colours(3)[1:])} <= shown
    assert rgb(NEUTRAL) not in shown
    draw_speeds(comparison(folder), folder / "heat.png", dpi=150)
    assert rgb(CLOSED_FILL) in colours_of(folder / "heat.png")


@for_each(
    ("closures", "stretch_m"),
    [
        ((), (130.0, 450.0)),
        ((Closure(0, 800.0),), (130.0, 850.0)),
        ((Closure(0, 950.0),), (260.0, 1000.0)),
        ((Closure(0, 600.0, 700.0), Closure(1, 900.0)), (130.0, 750.0)),
        ((Closure(0, 350.0, 900.0),), (130.0, 450.0)),
    ],
)
def test_snapshots_show_the_first_closed_part(
    closures: tuple[Closure, ...], stretch_m: tuple[float, float]
) -> None:
    assert default_stretch_m(evolve(DROP, road=evolve(DROP.road, closures=closures))) == stretch_m


def test_the_share_in_the_preferred_lane_is_left_out_without_preferences(tmp_path: Path) -> None:
    widths = []
    summary = make_summary(vehicles={"on_preferred_lane": 99})
    for scenario in (Scenario(), DROP):
        run = Run(tmp_path, "rolling", "formation", scenario, summary)
        draw_flows(Comparison.of([run]), tmp_path / "flows.png", dpi=60)
        with Image.open(tmp_path / "flows.png") as image:
            widths.append(image.width)
        headings = tables_of(Comparison.of([run, evolve(run, label="other")]))[0].headings
        assert ("in the preferred lane (%)" in headings) == (scenario is not DROP)
    assert widths[1] == widths[0] // 2


def test_a_vehicle_is_not_tilted_by_an_instantaneous_lane_change() -> None:
    t_s, y_m = np.array([0.0, 0.1, 0.2]), np.array([1.6, 1.6, 4.8])
    tracks = make_tracks(
        t_s,
        1,
        s_m=[20.0 * t_s],
        y_m=[y_m],
        speed_mps=[20.0],
        lateral_speed_mps=[np.array([0.0, 0.0, 32.0])],
    )
    poses = [_pose(tracks, 0, at_s) for at_s in (0.1, 0.14, 0.16, 0.2)]
    assert [pose[1:3] for pose in poses if pose] == [(1.6, 0.0), (1.6, 0.0), (4.8, 0.0), (4.8, 0.0)]


def test_the_angle_of_a_slow_vehicle_is_limited() -> None:
    t_s = np.array([0.0, 0.1, 0.2])
    tracks = make_tracks(t_s, 1, y_m=[1.0 + t_s], speed_mps=[0.5], lateral_speed_mps=[1.0])
    pose = _pose(tracks, 0, 0.1)
    assert pose is not None
    assert pose[2] == _MAX_HEADING


def test_the_share_in_the_preferred_lane_is_left_out_where_all_left_in_it(tmp_path: Path) -> None:
    for vehicles, differ in ((100, False), (99, True)):
        summary = make_summary(vehicles={"on_preferred_lane": vehicles})
        run = Run(tmp_path, "rolling", "formation", Scenario(), summary)
        assert shares_differ(Comparison.of([run])) == differ


def test_technical_rows_of_a_run_are_folded(tmp_path: Path) -> None:
    run = Run(tmp_path, "rolling", "formation", Scenario(), make_summary())
    shown, folded = tables_of(Comparison.of([run]))
    assert not shown.folded
    assert folded.folded
    rows = [("method", run.label), *summary_rows(make_summary(), Scenario())]
    assert sorted(rows) == sorted((*row,) for row in (*shown.rows, *folded.rows))
    assert "tick, median" in {row[0] for row in folded.rows}


def test_the_table_of_a_run_without_preferences(tmp_path: Path) -> None:
    for scenario, shown in ((Scenario(), "100.00 % of 100 vehicles"), (DROP, None)):
        run = Run(tmp_path, "rolling", "formation", scenario, make_summary())
        rows = {row[0]: row[1] for row in run_table(run).rows}
        assert rows.get("left in their preferred lane") == shown


@pytest.mark.more
def test_the_page_of_a_run_describes_closed_parts(tmp_path: Path) -> None:
    folder = make_run_without_preferences(tmp_path)
    page = report_run(Run(folder, "rolling", "formation", DROP, make_summary()), dpi=50)
    text = page.read_text(encoding="utf-8").replace("\u00a0", " ")
    assert "The right lane is closed from 800 m to the end of the road." in text
    assert "Vehicles have no preferred lanes." in text
    assert "strong if the lane is open from there to the end of the road" in text
    assert "prefers" not in text.partition("<script")[0]
    assert '<i class="closed"></i>closed' in text
    data = json.loads(text.partition('id="animation-0">')[2].partition("</script>")[0])
    assert {vehicle["lane"] for vehicle in data["vehicles"]} == {1, 2}
    assert "arrived in the middle lane" in text
    assert data["road"]["closed"] == [[0, 800.0, 1000.0]]
    assert (folder / "travel_time.png").exists()


@pytest.mark.more
def test_the_page_of_several_runs_shows_results_over_methods(tmp_path: Path) -> None:
    runs = []
    for label, seed in (("first", 1), ("second", 1), ("second", 2)):
        folder = make_run(tmp_path / f"{label}-{seed}")
        scenario = evolve(scenario_of(folder / "trips.parquet"), seed=seed)
        runs.append(Run(folder, label, "formation", scenario, make_summary()))
    page = report_comparison(Comparison.of(runs), tmp_path / "out", "three runs")
    text = page.read_text(encoding="utf-8")
    assert {"travel_times.png", "flows.png"} <= {path.name for path in page.parent.rglob("*.png")}
    assert "standard deviations over the seeds" in text
    assert "<h2>Throughput</h2>" in text  # everybody left in the preferred lane
    assert TOO_SHORT not in text


def test_given_times_and_stretch_and_resolution(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    small, large = tmp_path / "small.png", tmp_path / "large.png"
    for out, dpi in ((small, 50), (large, 100)):
        road_snapshots(folder, out, times=[70.0, 500.0], stretch_m=(100.0, 300.0), dpi=dpi)
    assert large.stat().st_size > small.stat().st_size


def test_runs_side_by_side(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / name, vehicles=n) for name, n in (("a", 12), ("b", 8), ("c", 2))]
    draw_travel_times(comparison(*folders), tmp_path / "new folder" / "box.png", dpi=60)
    assert is_picture(tmp_path / "new folder" / "box.png")


def speeds(*rows: tuple[float | None, ...]) -> MeanSpeeds:
    """Return mean speeds by bin; None: no vehicle."""
    values = np.ma.masked_invalid(np.array(rows, dtype=float))
    edges = [np.arange(size + 1.0) for size in values.shape]
    return MeanSpeeds(edges[0], edges[1], values)


def test_speeds_diverge_from_the_speed_of_the_lattice() -> None:
    some = speeds((15.0, 15.2, 14.8, None), (15.0,) * 4)
    norm, ticks = speed_scale([some], 15.0)
    assert (norm.vmin, norm.vmax) == (14.5, 15.5)  # the minimum
    assert ticks[len(ticks) // 2] == 15.0
    places = norm(some.speed_mps)
    assert places[0, 0] == pytest.approx(0.5)
    assert places[0, 1] - 0.5 == pytest.approx(0.5 - places[0, 2]) == pytest.approx(0.5 * 0.4**0.5)
    assert places.mask.tolist() == some.speed_mps.mask.tolist()


def test_the_scale_of_speeds_ends_at_a_percentile() -> None:
    """A single bin does not decide about the colours of all others."""
    calm = speeds((14.0, 16.0) * 100, (15.0,) * 200)
    jam = speeds((0.0,) + (15.0,) * 199)
    assert speed_scale([calm, jam], 15.0)[0].vmax == 16.0
    assert speed_scale([jam, speeds((3.0,) * 50)], 15.0)[0].vmin == 0.0
    # Each side has its own end, so that the strongest colours of both are used.
    norm, ticks = speed_scale([speeds((5.5,) * 50, (16.0,) * 50)], 15.0)
    assert (norm.vmin, norm.vmax) == (5.0, 16.0)
    assert ticks == pytest.approx([5.0, 10.0, 14.0, 15.0, 15.1, 15.5, 16.0])
    assert np.asarray(norm([5.0, 15.0, 16.0])) == pytest.approx([0.0, 0.5, 1.0])


def test_speeds_at_different_v_f_are_relative_to_it(tmp_path: Path) -> None:
    """One run drives at its v_F, the other one at three quarters of it."""
    slow = make_run(tmp_path / "slow")
    fast = make_run(tmp_path / "fast", formation={"speed_mps": 20.0})
    runs = comparison(slow, fast)
    panels: list[tuple[str, Any]] = []

    def bars(figure: Figure, *_: object, **__: object) -> None:
        drawn = [one for axes in figure.axes for one in axes.collections]
        means = [
            float(np.ma.asarray(one.get_array()).mean())
            for one in drawn
            if isinstance(one, QuadMesh)
        ]
        panels.append((figure.axes[-1].get_ylabel(), means))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Figure, "savefig", bars)
        draw_speeds(runs, tmp_path / "heat.png", dpi=60)
        draw_speeds(comparison(slow), tmp_path / "heat.png", dpi=60)
    (both, means), (alone, _) = panels
    assert both == "mean speed (% of $v_F$)\nwhite: $v_F$"
    assert alone == "mean speed (m/s)\nwhite: $v_F$ = 15 m/s"
    assert means[:2] == pytest.approx([75.0, 100.0])


def test_volumes_without_trajectories_have_no_panels(tmp_path: Path) -> None:
    """Seven volumes, of which a figure shows at most six, and trajectories at one of them."""
    folders = [
        make_run(tmp_path / str(number), demand={"volume_veh_per_lane_h": 900.0 + number})
        for number in range(7)
    ]
    for number, folder in enumerate(folders):
        if number != 3:
            (folder / "trajectories.parquet").unlink()
    runs = Comparison.of(
        Run(folder, "formation", "formation", scenario_of(folder / "trips.parquet"), None)
        for folder in folders
    )
    draw_speeds(runs, tmp_path / "heat.png", dpi=60)
    assert is_picture(tmp_path / "heat.png")


def test_only_sumo_moves_vehicles_from_lane_to_lane_at_once() -> None:
    t_s, width_m = 0.1 * np.arange(41), Scenario().road.lane_width_m
    for y_m, gradual in (
        (np.linspace(0.5, 1.5, 41) * width_m, True),
        (np.where(t_s < 2.0, 0.5, 1.5) * width_m, False),
    ):
        tracks = make_tracks(
            t_s, 1, s_m=[15.0 * t_s], y_m=[y_m], speed_mps=[15.0], accel_mps2=[0.0]
        )
        assert changes_gradually(tracks, Scenario()) is gradual


@pytest.mark.parametrize(
    ("file_format", "begin"), variants([(FigureFormat.SVG, b"<?xml"), (FigureFormat.PDF, b"%PDF")])
)
def test_figures_for_papers_are_vector_graphics(
    tmp_path: Path, file_format: FigureFormat, begin: bytes
) -> None:
    out = tmp_path / f"heat.{file_format}"
    runs = comparison(make_run(tmp_path / "run"))
    draw_speeds(runs, out, dpi=60)
    first = out.read_bytes()
    assert first.startswith(begin)
    draw_speeds(runs, out, dpi=60)
    assert out.read_bytes() == first


@pytest.mark.slow
def test_matplotlib_is_imported_only_to_draw() -> None:
    for module in ("figures", "snapshots"):
        assert not loads(f"laneweave.launch.report.{module}", "matplotlib")


@for_each("width_in", [3.0, 4.6, 9.2])
def test_a_legend_is_not_wider_than_its_figure(tmp_path: Path, width_in: float) -> None:
    with picture(width_in, 3.7, tmp_path / "legend.png", 100) as figure:
        axes = figure.subplots()
        for number in range(9):
            axes.plot([0.0, 1.0], [0.0, number], label=f"formations-{number}")
        legend_above(figure)
        (legend,) = figure.legends
        assert legend.get_window_extent().width <= figure.bbox.width
        assert len(legend.get_texts()) == 9
