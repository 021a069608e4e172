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
"""


def pytest_of(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    """Run the tests in a text, with the plug-in alone."""
    (folder / "test_it.py").write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_it.py"]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.slow
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
    assert "Traceback" not in ended.stdout
