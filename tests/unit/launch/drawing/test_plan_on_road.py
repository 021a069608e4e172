"""Plans on the road: simulated with the vehicles' controllers, and drawn."""

from __future__ import annotations

import json
from pathlib import Path

import attrs
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray
from PIL import Image

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.cli import plan_answers
from laneweave.launch.drawing import figures as drawing
from laneweave.launch.drawing import plan_on_road as road_drawing
from laneweave.launch.drawing.plan_on_road import (
    MAX_INSTANTS,
    Drive,
    _Picture,
    draw_road,
    drive_plan,
    road_figure,
)
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import cell_state
from support.commands import Here
from support.tables import for_each

EXAMPLES = Path(__file__).resolve().parents[4] / "docs" / "examples"
CASE_STUDY = EXAMPLES / "case-study.json"
REQUEST = PlanRequest.from_dict(json.loads(CASE_STUDY.read_text(encoding="utf-8")))
NAMES = [vehicle.id for vehicle in REQUEST.vehicles]
PLAN = plan(REQUEST)
NO_PLAN = PlanResponse("infeasible", None, None, None, (), (), 1.0, 1, 1)
SCENARIO = Scenario()


@pytest.fixture(scope="module")
def driven() -> Drive:
    return drive_plan(SCENARIO, NAMES, PLAN.paths)


def errors_m(drive: Drive, paths: tuple[tuple[Cell, ...], ...]) -> NDArray[np.float64]:
    """Return the distance of each body from its cell, along and across, at the end of each step."""
    lattice, slot = drive.scenario.lattice, drive.slot_ticks
    found = [
        [
            drive.states[number, k * slot] - cell_state(lattice, cell, drive.time_s(k * slot))
            for k, cell in enumerate(path)
        ]
        for number, path in enumerate(paths)
    ]
    return np.abs(np.array(found))[:, :, [0, 3]]


def test_all_vehicles_are_in_their_cells_when_a_step_ends(driven: Drive) -> None:
    assert PLAN.steps is not None
    assert driven.states.shape == (5, PLAN.steps * driven.slot_ticks + 1, 6)
    assert driven.time_s(driven.ticks) == pytest.approx(PLAN.steps * SCENARIO.timing.cycles_s[0])
    assert errors_m(driven, PLAN.paths).max() < 0.2


def test_what_the_conflict_kinds_allow_is_shown(driven: Drive) -> None:
    """With node and edge conflicts alone, vehicles 2 and 3 pass through each other's corners."""
    assert list(driven.overlaps) == [("2", "3")]
    assert 0 < driven.overlaps["2", "3"] < driven.slot_ticks
    careful = attrs.evolve(REQUEST, conflicts=("geometric",))
    apart = drive_plan(SCENARIO, NAMES, plan(careful).paths)
    assert apart.overlaps == {}
    assert apart.min_gap_m > 0


def test_the_scenario_determines_speeds_and_distances() -> None:
    slow = load_scenario(None, formation__cycle_s=6.0, formation__gap_m=12.0)
    drive = drive_plan(slow, NAMES, PLAN.paths)
    assert drive.time_s(drive.ticks) == pytest.approx(18.0)
    assert errors_m(drive, PLAN.paths).max() < 0.2
    assert float(np.ptp(drive.states[:, 0, 0])) == pytest.approx(24.0)


def test_a_panel_for_each_instant_shows_all_bodies_where_they_are(driven: Drive) -> None:
    figure = road_figure(_Picture.of(REQUEST, PLAN, SCENARIO))
    *roads, along, across = figure.axes
    overlap = driven.overlaps["2", "3"]  # is shown, too
    ticks = [0, overlap, *(step * driven.slot_ticks for step in (1, 2, 3))]
    for tick, axes in zip(ticks, roads, strict=True):
        shapes = [patch for patch in axes.patches if type(patch) is Polygon]
        fronts = [float(shape.get_xy()[:, 0].max()) for shape in shapes]
        expected = driven.states[:, tick, 0]
        assert fronts == pytest.approx(expected.tolist(), abs=0.5)
    assert [axes.get_ylabel() for axes in roads] == [f"{0.1 * tick:.1f} s" for tick in ticks]
    assert len(along.lines) == 5
    relative_m = [np.asarray(line.get_ydata()) for line in along.lines]
    ends = [path[-1][0] * SCENARIO.formation.gap_m for path in PLAN.paths]
    assert [float(line[-1]) for line in relative_m] == pytest.approx(ends, abs=0.2)
    assert {text.get_text() for text in across.texts} >= {"3, 4", "5", "1, 2"}
    title = f"conflict kinds allow that bodies overlap: 2 and 3 at {0.1 * overlap:.1f} s"
    assert title in figure.get_suptitle()


def test_long_plans_are_drawn_at_some_instants() -> None:
    request = PlanRequest.from_dict(
        {
            "schema": "laneweave.plan.request/1",
            "grid": {"columns": 20, "lanes": 1},
            "vehicles": [{"id": "$v$", "cell": [0, 0]}],
            "targets": [[19, 0]],
        }
    )
    figure = road_figure(_Picture.of(request, plan(request), SCENARIO))
    *roads, _, _ = figure.axes
    assert len(roads) == MAX_INSTANTS
    assert (roads[0].get_ylabel(), roads[-1].get_ylabel()) == ("0.0 s", "76.0 s")


@pytest.mark.more
@pytest.mark.slow
def test_without_a_plan_the_start_is_drawn(tmp_path: Path) -> None:
    figure = road_figure(_Picture.of(REQUEST, NO_PLAN, SCENARIO))
    assert len(figure.axes) == 3
    assert figure.get_suptitle() == "infeasible: the start"
    for name in ("start.png", "start.gif"):
        draw_road(REQUEST, NO_PLAN, SCENARIO, tmp_path / name)
        assert (tmp_path / name).stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.more
def test_an_animation_has_a_frame_for_each_tick(tmp_path: Path) -> None:
    request = attrs.evolve(REQUEST, vehicles=REQUEST.vehicles[:2])
    paths = tuple(path[:2] for path in PLAN.paths[:2])
    draw_road(request, attrs.evolve(PLAN, paths=paths), SCENARIO, tmp_path / "road.gif")
    with Image.open(tmp_path / "road.gif") as image:
        assert image.format == "GIF"
        frames: list[bytes] = []
        for frame in range(getattr(image, "n_frames", 1)):
            image.seek(frame)
            frames.append(image.convert("RGB").tobytes())
    assert len(frames) == 41
    assert len(set(frames)) == len(frames)


# --- the command ------------------------------------------------------------------------------


@pytest.mark.more
@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "shown"), [(None, "3 steps of 4 s"), ("[formation]\ncycle_s = 6.0", "of 6 s")]
)
def test_the_road_is_drawn_in_addition_to_the_response(
    laneweave: Here,
    scenario: str | None,
    shown: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A configuration without a router defines the road; the plan is made locally."""
    titles: list[str] = []

    def noted(figure: Figure, out: Path, dpi: float) -> None:
        titles.append(figure.get_suptitle())
        drawing.save(figure, out, dpi)

    monkeypatch.setattr(road_drawing, "save", noted)
    (tmp_path / "road.toml").write_text(scenario or "", encoding="utf-8")
    config = () if scenario is None else ("--config", tmp_path / "road.toml")
    status, out, _ = laneweave("plan", CASE_STUDY, "--draw-road", tmp_path / "road.png", *config)
    assert (status, json.loads(out)["cost"]) == (0, 7)
    assert (tmp_path / "road.png").read_bytes().startswith(b"\x89PNG")
    assert shown in titles[0]


@for_each(
    ("options", "line"),
    [
        (["--draw-road", "road.pdf"], "--draw-road: got 'road.pdf'; allowed: a file that ends"),
        (["--draw-road", "missing/road.png"], "--draw-road: got 'missing/road.png'"),
        (["--draw-road", "road.png", "--config", "fast.toml"], "formation.move_s: got 1.0"),
    ],
)
def test_plans_that_cannot_be_drawn_are_rejected_in_one_line(
    laneweave: Here, options: list[str], line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fast.toml").write_text("[formation]\nmove_s = 1.0", encoding="utf-8")
    monkeypatch.setattr(plan_answers, "plan", None)
    assert laneweave.refused("plan", CASE_STUDY, *options).startswith(line)
