"""Figures of plans: a panel for each time point, a colour for each team; animations."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import attrs
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle
from PIL import Image

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.launch.cli import plan_answers
from laneweave.launch.drawing import plan as plan_drawing
from laneweave.launch.drawing.plan import check_drawing, plan_figure, write_gif, write_png
from laneweave.protocol.errors import BadInputError
from support.commands import Here

CASE_STUDY = Path(__file__).resolve().parents[4] / "docs" / "examples" / "case-study.json"
REQUEST = PlanRequest.from_dict(json.loads(CASE_STUDY.read_text(encoding="utf-8")))
PATHS = (
    ((0, 0), (0, 0), (0, 0), (0, 0)),
    ((0, 2), (1, 2), (2, 1), (2, 0)),
    ((1, 1), (0, 2), (0, 2), (0, 2)),
    ((2, 0), (2, 1), (2, 2), (2, 2)),
    ((2, 2), (1, 1), (1, 1), (1, 1)),
)
PLAN = PlanResponse("optimal", 7, 6, 3, (0, 3, 1, 4, 2), PATHS, 1.0, 1, 1)
NO_PLAN = PlanResponse("infeasible", None, None, None, (), (), 1.0, 1, 1)
BLOCKED = PlanRequest.from_dict(
    {
        "schema": "laneweave.plan.request/1",
        "grid": {"columns": 4, "lanes": 2, "blocked": [[1, 0], [1, 1]]},
        "vehicles": [{"id": "$v$", "cell": [0, 1]}],
        "targets": [[3, 0], [2, 1]],
    }
)


def bodies(axes: Axes) -> dict[str, FancyBboxPatch]:
    """Return the vehicles of a panel by their names."""
    found = [patch for patch in axes.patches if isinstance(patch, FancyBboxPatch)]
    return {str(patch.get_label()): patch for patch in found}


def cell_of(body: FancyBboxPatch) -> tuple[int, int]:
    x, y = body.get_x() + body.get_width() / 2, body.get_y() + body.get_height() / 2
    return round(x), round(y / plan_drawing._LANE_HEIGHT)


def outlines(axes: Axes, label: str) -> list[Rectangle]:
    found = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
    return [patch for patch in found if patch.get_label() == label]


def test_a_panel_per_time_point_shows_all_vehicles() -> None:
    figure = plan_figure(REQUEST, PLAN)
    assert len(figure.axes) == 4
    for time, axes in enumerate(figure.axes):
        shown = [cell_of(body) for body in bodies(axes).values()]
        assert shown == [path[time] for path in PATHS]
    assert figure.get_suptitle() == "optimal, cost 7, lower bound 6, 3 steps"
    assert [axes.get_title() for axes in figure.axes[:2]] == ["step 0", "step 1"]
    # Arrows show the next moves.
    arrows = [
        sum(isinstance(patch, FancyArrowPatch) for patch in axes.patches) for axes in figure.axes
    ]
    assert arrows == [4, 2, 1, 0]


@pytest.mark.slow
def test_panels_do_not_overlap() -> None:
    figure = plan_figure(*long_plan(10))
    figure.draw_without_rendering()
    boxes = [axes.get_position() for axes in figure.axes]
    assert len({round(box.y0, 6) for box in boxes}) == 3
    for number, box in enumerate(boxes):
        assert 0 < box.x0 < box.x1 < 1
        assert 0 < box.y0 < box.y1 < 1
        assert not any(box.overlaps(other) for other in boxes[:number])


def test_a_team_and_its_targets_share_a_colour() -> None:
    axes = plan_figure(REQUEST, PLAN).axes[0]
    colours = {name: to_hex(body.get_facecolor()) for name, body in bodies(axes).items()}
    assert colours["1"] == colours["2"]
    assert colours["3"] == colours["4"]
    assert len({colours["1"], colours["3"], colours["5"]}) == 3
    targets = [to_hex(outline.get_edgecolor()) for outline in outlines(axes, "target")]
    assert targets == [colours[name] for name in ("1", "3", "5", "1", "3")]


def test_a_target_of_two_teams_has_both_colours() -> None:
    vehicles = (attrs.evolve(REQUEST.vehicles[0], eligible=(0, 1)), *REQUEST.vehicles[1:])
    axes = plan_figure(attrs.evolve(REQUEST, vehicles=vehicles), NO_PLAN).axes[0]
    assert len(outlines(axes, "target")) == 5 + 2


def test_without_a_plan_the_start_is_drawn() -> None:
    figure = plan_figure(BLOCKED, NO_PLAN)
    (axes,) = figure.axes
    assert [cell_of(body) for body in bodies(axes).values()] == [(0, 1)]
    assert (len(outlines(axes, "blocked")), len(outlines(axes, "target"))) == (2, 2)
    assert all(outline.get_hatch() for outline in outlines(axes, "blocked"))
    assert figure.get_suptitle() == "infeasible: there is no plan"
    timeout = attrs.evolve(NO_PLAN, status="timeout", lower_bound=5)
    title = plan_figure(BLOCKED, timeout).get_suptitle()
    assert title == "timeout: no plan was found, lower bound 5"


def long_plan(steps: int) -> tuple[PlanRequest, PlanResponse]:
    """Return a plan in which one vehicle waits for long."""
    path = ((0, 1),) * steps + ((0, 0),)
    return BLOCKED, attrs.evolve(PLAN, steps=steps, paths=(path,))


def test_a_long_plan_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan_drawing, "MAX_PANELS", 5)
    figure = plan_figure(*long_plan(5))
    assert len(figure.axes) == 5
    assert figure.get_suptitle().endswith("5 steps, the first 4 drawn")
    monkeypatch.setattr(plan_drawing, "MAX_MOVING_FRAMES", 8)
    times = list(plan_drawing._frame_times(16))
    assert sorted(set(times)) == [0, 2, 4, 6, 8, 10, 12, 14, 16]


def test_the_longest_road_stays_within_memory(tmp_path: Path) -> None:
    request = attrs.evolve(BLOCKED, grid=attrs.evolve(BLOCKED.grid, columns=1000))
    write_png(request, NO_PLAN, tmp_path / "road.png")
    with Image.open(tmp_path / "road.png") as image:
        assert image.format == "PNG"
        assert 10_000 < image.width <= 30_000


@pytest.mark.more
@pytest.mark.slow
def test_a_gif_moves_and_begins_again(tmp_path: Path) -> None:
    out = tmp_path / "plan.GIF"
    request, plan = long_plan(1)
    write_gif(request, plan, out, dpi=40)
    with Image.open(out) as image:
        assert image.format == "GIF"
        # The first and the last frame are held, the others differ from each other.
        assert getattr(image, "n_frames", 1) == plan_drawing.FRAMES_PER_STEP + 1
        assert image.info["loop"] == 0


def test_vehicles_move_smoothly_between_cells() -> None:
    times = sorted(set(plan_drawing._frame_times(1)))
    moves = [there - here for here, there in pairwise(times)]
    assert moves[0] < 0.1 < moves[5]
    assert moves[-1] < 0.1
    assert plan_drawing._positions(REQUEST, PLAN, 0.5)[1] == (0.5, 2)


def test_names_are_short_and_printable() -> None:
    names = ("v1", "vehicle-000123", "a\nb", "\ud800")
    assert [plan_drawing.short_name(name) for name in names] == ["v1", "…00123", "a?b", "?"]


@pytest.mark.parametrize(
    ("name", "allowed"),
    [
        ("plan.pdf", "ends with .png or .gif"),
        ("plan", "ends with .png or .gif"),
        (".png", "ends with .png or .gif"),
        ("missing/plan.png", "a folder that exists"),
        ("file/plan.gif", "a folder that exists"),
        ("folder.png", "Is a directory"),
        ("p" * 300 + ".png", "File name too long"),
    ],
)
def test_bad_places_are_refused_before_planning(
    laneweave: Here, name: str, allowed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").touch()
    monkeypatch.setattr(plan_answers, "plan", None)
    line = laneweave.refused("plan", CASE_STUDY, "--draw", tmp_path / name)
    assert line.startswith("--draw: got ")
    assert allowed in line


def test_the_check_leaves_nothing_behind(tmp_path: Path) -> None:
    check_drawing(tmp_path / "new.png")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "old.gif").write_text("old", encoding="utf-8")
    check_drawing(tmp_path / "old.gif")
    assert (tmp_path / "old.gif").read_text(encoding="utf-8") == "old"


def test_a_read_only_folder_is_refused() -> None:
    with pytest.raises(BadInputError, match="a file that can be written"):
        check_drawing(Path("/proc/plan.png"))


@pytest.mark.parametrize("endpoint", [None, "tcp/127.0.0.1:1"])
def test_the_response_is_printed_and_drawn(
    laneweave: Here, endpoint: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_answers, "plan", lambda *_, **__: PLAN)
    monkeypatch.setattr(plan_answers, "_ask", lambda *_: PLAN)
    connect = () if endpoint is None else ("--connect", endpoint)
    status, out, _ = laneweave("plan", CASE_STUDY, "--draw", tmp_path / "plan.png", *connect)
    assert (status, json.loads(out)) == (0, PLAN.to_dict())
    assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")


def test_a_failed_drawing_is_reported(
    laneweave: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(plan_answers, "plan", lambda *_, **__: PLAN)
    monkeypatch.setattr(plan_drawing, "draw_plan", full)
    status, out, (line,) = laneweave("plan", CASE_STUDY, "--draw", tmp_path / "plan.png")
    assert (status, json.loads(out)["cost"]) == (1, 7)
    assert "cannot be drawn" in line
