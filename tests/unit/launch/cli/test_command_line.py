"""Parts of the command line that need no process: run folders, options, last errors."""

import json
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import pytest

from laneweave.launch.cli.main import _status
from laneweave.launch.cli.options import parse_seeds
from laneweave.launch.run import run_folder
from laneweave.launch.run.local_run import MAX_TEMPORARY_BYTES, check_temporary_folder
from laneweave.launch.run.logs import last_error
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.deployment_fields import check_pace
from laneweave.protocol.scenario.fields import Scenario
from support.commands import Here


def new_folder(out: Path | None, settings: Scenario | None = None) -> Path:
    with run_folder.new_folder(out, settings or Scenario(), "formation") as folder:
        return folder


def test_the_name_of_a_new_folder_describes_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda _: "20260102-030405")
    settings = load_scenario(None, seed=7, demand__volume_veh_per_lane_h=1450.5)

    folders = [new_folder(None, settings) for _ in range(3)]

    name = "formation-1450.5-seed7-20260102-030405"
    assert [str(folder) for folder in folders] == [
        f"runs/{name}",
        f"runs/{name}-2",
        f"runs/{name}-3",
    ]
    assert all(folder.is_dir() for folder in folders)


def test_a_run_that_fails_later_keeps_its_files(tmp_path: Path) -> None:
    out = tmp_path / "out"
    failure = pytest.raises(BadInputError)
    with failure, run_folder.new_folder(out, Scenario(), "formation") as folder:
        (folder / "events.jsonl").touch()
        raise BadInputError("network.endpoint", "", "a router")
    assert {path.name for path in out.iterdir()} == {"log.jsonl", "events.jsonl"}


def test_paces() -> None:
    for possible in (None, 0.01, 1, 1000):
        check_pace(possible, "--pace")
    for pace in (0, -1, 1001, float("nan"), float("inf")):
        with pytest.raises(BadInputError, match="--pace"):
            check_pace(pace, "--pace")


def test_sockets_must_fit_below_the_temporary_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    longest = "/" + "t" * (MAX_TEMPORARY_BYTES - 1)
    monkeypatch.setattr(tempfile, "tempdir", longest)
    check_temporary_folder()
    monkeypatch.setattr(tempfile, "tempdir", longest + "t")
    with pytest.raises(BadInputError, match="TMPDIR"):
        check_temporary_folder()


def test_the_last_error_of_a_process(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    assert last_error(path, "bridge") == ""
    entries = (
        {"name": "bridge", "level": "error", "event": "first"},
        {"name": "bridge", "level": "error", "event": "x", "exception": "Traceback\n  y\nE: z\n"},
        {"name": "bridge", "level": "info", "event": "stopping"},
        {"name": "c1", "level": "error", "event": "cannot start", "reason": "no router"},
    )
    lines = [json.dumps(entry) for entry in entries]
    path.write_text("\n".join([*lines, '{"name": "bri']), encoding="utf-8")

    assert last_error(path, "bridge") == "E: z"
    assert last_error(path, "c1") == "no router"
    assert last_error(path, "c2") == ""


def test_the_version_is_that_of_the_package(laneweave: Here) -> None:
    assert laneweave("--version") == (0, f"laneweave {version('laneweave')}\n", [])


@pytest.mark.parametrize(
    ("words", "found"), [("laneweave pla", "plan"), ("laneweave run --meth", "--method")]
)
def test_the_shell_completes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, words: str, found: str
) -> None:
    monkeypatch.setenv("_LANEWEAVE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    with pytest.raises(SystemExit, match="0"):
        _status([])
    assert capsys.readouterr() == (f"{found}\n", "")


def test_ranges_of_seeds_are_explained(laneweave: Here) -> None:
    for command in ("sweep", "simulate"):
        _, out, _ = laneweave(command, "--help")
        assert "1:4 means 1, 2 and 3" in " ".join(out.replace("│", " ").split())
    assert list(parse_seeds("1:4")) == [1, 2, 3]
    assert list(parse_seeds("7:8")) == [7]
