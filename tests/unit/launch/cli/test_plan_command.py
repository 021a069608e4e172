"""`laneweave plan`: whose solver plans, and what is printed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from support.commands import Here
from support.tables import for_each

CASE_STUDY = Path(__file__).parents[4] / "docs" / "examples" / "case-study.json"


@for_each(
    ("written", "option", "planned"),
    [
        (None, None, "branching"),
        ("branching", None, "branching"),
        (None, "branching", "branching"),
        ("branching", "tappa", "tappa"),
    ],
)
def test_the_option_goes_before_the_file_and_the_file_before_the_default(
    laneweave: Here, tmp_path: Path, written: str | None, option: str | None, planned: str
) -> None:
    more = {} if written is None else {"solver": written}
    path = request_file(tmp_path, **more)
    _, out, _ = laneweave("plan", path, *([] if option is None else ["--solver", option]))
    answer = json.loads(out)
    assert (answer["solver"], answer["cost"], answer.get("fallback")) == (planned, 7, None)


def test_an_unknown_solver_is_refused(laneweave: Here, tmp_path: Path) -> None:
    line = laneweave.refused("plan", request_file(tmp_path), "--solver", "magic")
    allowed = "one of tappa, branching, or the name of a plug-in that is installed"
    assert line == f"solver: got 'magic'; allowed: {allowed}"


def test_the_table_counts_steps_from_the_start(laneweave: Here, tmp_path: Path) -> None:
    path = request_file(tmp_path)
    _, out, _ = laneweave("plan", path, "--format", "table")
    assert ", 3 steps, " in out
    assert out.splitlines()[2].split("  ")[1:] == [f"step {step}" for step in range(4)]
    _, explained, _ = laneweave("plan", path, "--explain")
    assert out.splitlines()[2] in explained
    assert "Step 0 is the start" in explained


def test_the_table_names_the_solver(laneweave: Here, tmp_path: Path) -> None:
    path = request_file(tmp_path, conflicts=["edge"])
    for solver, said in (("tappa", "tappa"), ("branching", "tappa (fallback)")):
        _, out, _ = laneweave("plan", path, "--format", "table", "--solver", solver)
        assert out.splitlines()[0].endswith(f"planned by {said}")


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", sorted(CASE_STUDY.parent.glob("*.json")), ids=lambda path: path.stem
)
def test_the_examples_are_planned_and_drawn(laneweave: Here, path: Path, tmp_path: Path) -> None:
    picture = tmp_path / "plan.png"
    _, out, errors = laneweave("plan", path, "--draw", picture)
    assert json.loads(out)["status"] == "optimal"
    assert picture.exists()
    assert errors == [f"drawing: {picture}"]


def request_file(folder: Path, **changes: object) -> str:
    """Write the case study with some changes; a change to None removes a field."""
    request: dict[str, Any] = json.loads(CASE_STUDY.read_text(encoding="utf-8")) | changes
    path = folder / "request.json"
    kept = {name: value for name, value in request.items() if value is not None}
    path.write_text(json.dumps(kept), encoding="utf-8")
    return str(path)
