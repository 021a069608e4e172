"""`laneweave plan --explain` as text and as a figure."""

from pathlib import Path

import attrs
import pytest
from matplotlib.image import imread

from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.paper.explanation import explain
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.launch.bench.request_families import traffic_request
from laneweave.launch.cli.plan_answers import explain_request
from laneweave.launch.drawing.tappa_process import explanation_figure
from laneweave.launch.drawing.tappa_text import IMPROVED, LITERAL, explanation_text
from laneweave.protocol.errors import BadInputError

CASE_STUDY = Path(__file__).parents[4] / "docs" / "examples" / "case-study.json"


def test_text_of_the_case_study(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    picture = tmp_path / "solving.png"
    explain_request(CASE_STUDY, None, picture)
    lines = capsys.readouterr().out.splitlines()
    assert LITERAL in lines[0]
    assert "1  [1, 4, 2, 5, 3]    6     7    7      5" in lines
    assert "Ended: C_3 = 8 >= C'* = 7" in lines
    assert "├─ N_2  {N | (1,1), 1, 2}  L = 7, solution: no conflicts" in lines
    assert imread(picture).shape[1] == 1800


def test_an_animation_of_an_explanation_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="--draw"):
        explain_request(CASE_STUDY, None, tmp_path / "solving.gif")


def test_large_trees_are_the_improved_ones_and_are_cut_short() -> None:
    request = next(
        request
        for request in map(traffic_request, range(1000))
        if request.grid.columns == 3 and len(request.vehicles) == 6
    )
    told = explain(attrs.evolve(request, deadline_s=60.0))
    text = explanation_text(told)
    assert IMPROVED in text
    assert "more nodes" in text
    texts = {text.get_text() for axes in explanation_figure(told).axes for text in axes.texts}
    assert any("more nodes are not drawn" in text for text in texts)
    assert any(text.startswith("A₁\n") for text in texts)


def test_a_picture_without_a_plan_shows_the_first_tree() -> None:
    vehicles = (
        VehicleRequest("a", (0, 0), eligible=(1,)),
        VehicleRequest("b", (1, 0), eligible=(0,)),
    )
    request = PlanRequest(Grid(2, 1), 1, ("node", "edge"), vehicles, ((0, 0), (1, 0)))
    texts = {t.get_text() for axes in explanation_figure(explain(request)).axes for t in axes.texts}
    assert "none below C\u2032*" in texts
