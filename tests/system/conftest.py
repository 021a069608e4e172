"""Fixtures of the system tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from support.harness import DEMAND, ROAD, Lab, laboratory
from support.sharing import made_once


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    """Processes of this test; whatever is left of them at its end is an error."""
    with laboratory(tmp_path) as laboratory_of_test:
        yield laboratory_of_test


@pytest.fixture
def road(lab: Lab) -> Path:
    """A scenario whose lane sorting begins early."""
    return lab.path("road.toml", ROAD)


FinishedRun = Callable[[str], Path]

_RUNS: dict[str, tuple[str, ...]] = {
    "zenoh": ("--report",),
    "packed": ("--vehicles-per-process", "8"),
    "simulated": ("--transport", "simulated"),
}


@pytest.fixture
def finished_run(lab: Lab, road: Path, tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    """Return the folder of a run of `road` that all tests share; the first one who asks runs it."""

    def run(name: str, folder: Path) -> None:
        ended = lab.run("run", road, *DEMAND, *_RUNS[name], "--out", folder)
        assert ended.status == 0, ended
        (folder / "stdout.txt").write_text(ended.out, encoding="utf-8")
        (folder / "stderr.txt").write_text(ended.err, encoding="utf-8")

    return lambda name: made_once(tmp_path_factory, f"run-{name}", partial(run, name))
