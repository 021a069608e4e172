"""Folders of new runs: claimed by one run, used again after an interrupted start."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from attrs import evolve

from laneweave.launch.recordings.files import EVENTS_FILE
from laneweave.launch.run.run_folder import LOG_FILE, new_folder, repair_run
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import read_summary, write_summary
from support.summaries import make_summary


@pytest.fixture
def claims() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def claim(claims: ExitStack, folder: Path) -> Path:
    return claims.enter_context(new_folder(folder, Scenario(), "formation"))


def refusal(folder: Path) -> str:
    with pytest.raises(BadInputError) as refused, new_folder(folder, Scenario(), "formation"):
        pass
    assert refused.value.field == "--out"
    return str(refused.value)


def write_events(folder: Path, *kinds: str) -> None:
    folder.mkdir(exist_ok=True)
    lines = [json.dumps({"t_s": 1.0, "kind": kind}) for kind in kinds]
    (folder / EVENTS_FILE).write_text("\n".join(lines) + '\n{"cut', encoding="utf-8")


def test_a_folder_is_used_by_one_run_at_a_time(tmp_path: Path, claims: ExitStack) -> None:
    folder = claim(claims, tmp_path / "new")
    assert [path.name for path in folder.iterdir()] == [LOG_FILE]
    assert "another run uses this one" in refusal(folder)
    claims.close()
    assert claim(claims, folder) == folder


@pytest.mark.parametrize("error", [KeyboardInterrupt, BadInputError("a", "b", "c")])
@pytest.mark.parametrize("existed", [False, True])
def test_a_run_that_does_not_begin_leaves_the_folder_as_it_was(
    tmp_path: Path, error: BaseException, *, existed: bool
) -> None:
    folder = tmp_path / "out"
    if existed:
        folder.mkdir()

    def use() -> None:
        with new_folder(folder, Scenario(), "formation"):
            (folder / LOG_FILE).write_text("{}\n", encoding="utf-8")
            raise error

    with pytest.raises((KeyboardInterrupt, BadInputError)):
        use()
    assert folder.exists() is existed
    assert not existed or list(folder.iterdir()) == []


def test_what_an_interrupted_start_has_left_is_used_again(
    tmp_path: Path, claims: ExitStack
) -> None:
    write_events(tmp_path, "leader", "demanded")
    for name in (LOG_FILE, "trips.parquet", "trajectories.parquet", "ticks.parquet"):
        (tmp_path / name).write_text("left", encoding="utf-8")
    write_summary(tmp_path, make_summary(ending="interrupted"))
    claim(claims, tmp_path)
    assert [(path.name, path.stat().st_size) for path in tmp_path.iterdir()] == [(LOG_FILE, 0)]


def test_results_and_files_of_others_are_never_removed(tmp_path: Path) -> None:
    recorded, complete, foreign, broken, copied = (tmp_path / name for name in "abcde")
    copied.mkdir()
    for name in ("trips.parquet", "trajectories.parquet", "ticks.parquet"):
        (copied / name).touch()
    write_events(recorded, "leader", "entered")
    for folder in (complete, foreign, broken):
        write_events(folder)
    write_summary(complete, make_summary(ending="complete"))
    (foreign / "notes.txt").touch()
    (broken / "summary.json").touch()
    assert refusal(foreign / "notes.txt").endswith("a new or empty folder")
    for folder in (recorded, complete, foreign, broken, copied):
        before = sorted(folder.iterdir())
        assert refusal(folder).endswith("a new or empty folder")
        assert sorted(folder.iterdir()) == before


# --- killed runs ------------------------------------------------------------------------------


def killed(folder: Path, ending: str = "unfinished") -> Path:
    write_events(folder, "entered", "left")
    (folder / LOG_FILE).touch()
    write_summary(folder, evolve(make_summary(), ending=ending))
    return folder


def test_the_files_of_a_killed_run_are_completed(tmp_path: Path) -> None:
    folder = killed(tmp_path / "run")
    assert repair_run(folder).ending == "interrupted"
    summary = read_summary(folder)
    assert summary is not None
    assert summary.ending == "interrupted"
    events = (folder / EVENTS_FILE).read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["kind"] for line in events] == ["entered", "left"]


@pytest.mark.parametrize("ending", ["complete", "limit", "interrupted"])
def test_a_run_that_has_ended_is_not_repaired(tmp_path: Path, ending: str) -> None:
    folder = killed(tmp_path / "run", ending)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(BadInputError, match=ending):
        repair_run(folder)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_run_that_goes_on_is_not_repaired(tmp_path: Path, claims: ExitStack) -> None:
    folder = killed(claim(claims, tmp_path / "run"))
    with pytest.raises(BadInputError, match="in use"):
        repair_run(folder)


def test_a_folder_without_a_summary_is_not_repaired(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="killed after its first seconds"):
        repair_run(tmp_path)
