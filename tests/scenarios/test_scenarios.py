"""Every scenario in this folder runs exactly as written; `scenario_files` explains the language."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from scenarios.scenario_files import check_scenario, ends_in_collision, read_scenario
from scenarios.scenario_runner import Runner
from scenarios.scenario_text import CollisionError, ScenarioError
from support.tables import for_each

HERE = Path(__file__).parent
SCENARIOS = sorted(HERE.glob("*.txt"))


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_scenario(path: Path) -> None:
    check_scenario(path)


@for_each("path", SCENARIOS)
def test_scenario_says_first_what_it_shows(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    head = [line for line in lines[:5] if line.startswith("#")]
    assert 1 <= len(head) <= 4
    assert lines[: len(head)] == head
    assert head[0].endswith("."), "the first line is a sentence of its own: README.md lists it"


def test_readme_lists_all_scenarios() -> None:
    listed = re.findall(
        r"^\| \[(\w+)\]\((\w+)\.txt\) \| (.+) \|$",
        (HERE / "README.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    first_lines = {
        path.stem: path.read_text(encoding="utf-8").splitlines()[0].removeprefix("# ")
        for path in SCENARIOS
    }
    assert all(name == link for name, link, _ in listed)
    assert len(listed) == len(SCENARIOS)
    assert {name: text for name, _, text in listed} == first_lines


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("=> A promises", "without a command"),
        ("A jumps", "no such command"),
        ("A ticks", "there is no 'A'"),
        ("vehicle A at 0,0 wants 1\nvehicle B at 0,0 wants 1", "both occupy"),
        ("vehicle A at 0,0 wants 1\nA ticks\n=> A moves 0,0 > 0,1", "A holds 0,0"),
        ("vehicle A at 0,0 wants 1\nA gets PLAN 1/L1/1/1", "was never sent"),
        ("clock 2.0\nclock 1.0", "it is 2 s already"),
        ("vehicle A at 0,0 wants 1\nleader L1 term 1 leads A\nL1 hears A", "L1 preparing"),
    ],
)
def test_a_wrong_scenario_names_its_error(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "wrong.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError, match=complaint):
        check_scenario(path)


def test_a_moving_vehicle_occupies_both_cells(tmp_path: Path) -> None:
    path = tmp_path / "collision.txt"
    path.write_text(
        """
        vehicle A at 0,0 wants 1
        leader L1 term 1 leads A
        L1 collects promises
          => A promise 1/L1/1/1
        L1 brings A@0>-1,1 into force
          => A accept 1/L1/1/1
        A ticks
          => A's gate is open
          => A moves 0,0 > -1,1
        vehicle B at -1,0 wants 0   # a corner of A's way
        """,
        encoding="utf-8",
    )
    with pytest.raises(CollisionError, match="both occupy"):
        check_scenario(path)
    assert ends_in_collision(path, Runner())
    assert len(read_scenario(path)) == 6
