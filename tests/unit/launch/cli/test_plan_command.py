"""`laneweave plan`: whose solver plans, and what is printed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from laneweave.launch.cli import main as cli
from laneweave.launch.run import logs

CASE_STUDY = Path(__file__).parents[4] / "docs" / "examples" / "case-study.json"


@pytest.fixture(autouse=True)
def _logs_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command would bind them to a stream that ends with the test."""
    monkeypatch.setattr(logs, "log_to_terminal", lambda: None)


@pytest.mark.parametrize(
    ("written", "option", "planned"),
    [
        (None, None, "tappa"),
        ("branching", None, "branching"),
        (None, "branching", "branching"),
        ("branching", "tappa", "tappa"),
    ],
)
def test_the_option_goes_before_the_file_and_the_file_before_the_default(
    written: str | None,
    option: str | None,
    planned: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    more = {} if written is None else {"solver": written}
    path = request_file(tmp_path, **more)
    assert cli._status(["plan", path, *([] if option is None else ["--solver", option])]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["solver"], answer["cost"], answer.get("fallback")) == (planned, 7, None)


def test_an_unknown_solver_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli._status(["plan", request_file(tmp_path), "--solver", "magic"]) == 2
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == (
        "",
        "solver: got 'magic'; allowed: one of tappa, branching\n",
    )


def test_the_table_names_the_solver(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = request_file(tmp_path, conflicts=["edge"])
    arguments = ["plan", path, "--format", "table", "--solver"]
    for solver, said in (("tappa", "tappa"), ("branching", "tappa (fallback)")):
        assert cli._status([*arguments, solver]) == 0
        assert capsys.readouterr().out.splitlines()[0].endswith(f"planned by {said}")


@pytest.mark.parametrize(
    "path", sorted(CASE_STUDY.parent.glob("*.json")), ids=lambda path: path.stem
)
def test_the_examples_are_planned_and_drawn(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli._status(["plan", str(path), "--draw", str(tmp_path / "plan.png")]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "optimal"
    assert (tmp_path / "plan.png").exists()


def request_file(folder: Path, **changes: object) -> str:
    """Write the case study with some changes; a change to None removes a field."""
    request: dict[str, Any] = json.loads(CASE_STUDY.read_text(encoding="utf-8")) | changes
    path = folder / "request.json"
    kept = {name: value for name, value in request.items() if value is not None}
    path.write_text(json.dumps(kept), encoding="utf-8")
    return str(path)
