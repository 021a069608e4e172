"""Fixtures of the system tests."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from system.harness import DEMAND, ROAD, Lab


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    """Processes of this test; whatever is left of them at its end is an error."""
    sockets = Path(tempfile.mkdtemp(prefix="lw-"))
    laboratory = Lab(tmp_path, sockets)
    try:
        yield laboratory
    finally:
        left = laboratory.kill_rest()
        shutil.rmtree(sockets, ignore_errors=True)
    assert not left


@pytest.fixture
def road(lab: Lab) -> Path:
    """A scenario whose lane sorting begins early."""
    return lab.path("road.toml", ROAD)


FinishedRun = Callable[[str], Path]

_RUNS: dict[str, tuple[str, ...]] = {
    "zenoh": (),
    "packed": ("--vehicles-per-process", "8"),
    "simulated": ("--transport", "simulated"),
}


@pytest.fixture
def finished_run(lab: Lab, road: Path, tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    """Return the folder of a run of `road` that all tests share; the first one who asks runs it."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def folder_of(name: str) -> Path:
        folder = shared / f"run-{name}"
        with (shared / f"run-{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.exists():
                unfinished = lab.folder / name
                ended = lab.run("run", road, *DEMAND, *_RUNS[name], "--out", unfinished)
                assert ended.status == 0, ended
                (unfinished / "stdout.txt").write_text(ended.out, encoding="utf-8")
                (unfinished / "stderr.txt").write_text(ended.err, encoding="utf-8")
                unfinished.rename(folder)
        return folder

    return folder_of
