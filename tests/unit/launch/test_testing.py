"""The pytest plug-in: the guide's example, and what a failing test says."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
BROKEN = """
def test_a_run_that_is_not_complete(laneweave_run):
    laneweave_run(demand__duration_s=10.0, runtime__max_road_s=12.0)

def test_an_unknown_fault(laneweave_run):
    laneweave_run(faults={"kill": [{"target": "leder", "at_s": 1.0}]})

def test_several_wrong_values(laneweave_run):
    laneweave_run(faults={"messages": [{"topics": ["sate"], "loss": 2.0, "between": "c1"}]})

def test_arguments(laneweave_run):
    laneweave_run(out="here")

def test_faults_of_another_type(laneweave_run):
    laneweave_run(faults=[1])
"""


def pytest_of(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    """Run the tests in a text, with the plug-in alone."""
    (folder / "test_it.py").write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_it.py"]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.slow
@pytest.mark.more
def test_the_example_of_the_guide_passes(tmp_path: Path) -> None:
    guide = (ROOT / "docs" / "FAULTS.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(import pytest\n.*?)```", guide, re.DOTALL)
    ended = pytest_of(tmp_path, example)
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.mark.slow
def test_a_test_fails_with_the_reason(tmp_path: Path) -> None:
    ended = pytest_of(tmp_path, BROKEN)
    assert ended.returncode == 1
    assert "the run is not complete: limit" in ended.stdout
    assert "files of the run: " in ended.stdout
    assert "kill[0].target: got 'leder'" in ended.stdout
    assert "did you mean state?" in ended.stdout
    assert "messages[0].loss: got 2.0; allowed: [0, 1]" in ended.stdout
    assert "messages[0].between: got 'c1'; allowed: a list of 2 strings" in ended.stdout
    assert "out: got 'here'; allowed: nothing" in ended.stdout
    assert " faults: got [1]; allowed: tables of faults, a file, or the name" in ended.stdout
    assert "Traceback" not in ended.stdout
    assert "launch/" not in ended.stdout, "frames of the library"
