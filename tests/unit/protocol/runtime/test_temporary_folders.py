"""Temporary folders: removed with their processes, or by the next one."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from laneweave.protocol.runtime.temporary_folders import (
    OWNER_FILE,
    hold_folder,
    remove_abandoned,
    temporary_folder,
)

HOLDER = """
import sys, time
from pathlib import Path
from laneweave.protocol.runtime import temporary_folders as folders
if len(sys.argv) > 1:
    folders.hold_folder(Path(sys.argv[1]))
    print("held", flush=True)
    time.sleep(60)
with folders.temporary_folder("sumo") as folder:
    (folder / "net.xml").touch()
    print(folder, flush=True)
    time.sleep(60)
"""


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def holder(*arguments: object) -> tuple[subprocess.Popen[str], str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, *map(str, arguments)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    return process, process.stdout.readline().strip()


def end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()


def test_a_folder_is_removed_at_the_end(temporary: Path) -> None:
    def use() -> None:
        with temporary_folder("sumo") as folder:
            assert folder.name.startswith("laneweave-sumo-")
            (folder / "inner").mkdir()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        use()
    assert list(temporary.iterdir()) == []


def test_the_folder_of_a_killed_process_is_removed_by_the_next_one(temporary: Path) -> None:
    process, folder = holder()
    remove_abandoned()
    assert (Path(folder) / "net.xml").exists()
    end(process)
    with temporary_folder() as own:
        assert list(temporary.iterdir()) == [own]


def test_a_process_that_holds_a_folder_keeps_it(temporary: Path) -> None:
    owner, folder = holder()
    role, said = holder(folder)
    assert said == "held"
    end(owner)
    remove_abandoned()
    assert Path(folder).exists()
    end(role)
    remove_abandoned()
    assert list(temporary.iterdir()) == []


def test_other_folders_are_not_touched(temporary: Path) -> None:
    own = temporary / "laneweave-results"
    own.mkdir()
    other = temporary / "other"
    other.mkdir()
    (other / OWNER_FILE).touch()
    (temporary / "laneweave-link").symlink_to(other)
    remove_abandoned()
    assert {path.name for path in temporary.iterdir()} == {
        "laneweave-link", "laneweave-results", "other"
    }  # fmt: skip
    assert (other / OWNER_FILE).exists()


def test_folders_of_other_users_are_not_touched(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = temporary / "laneweave-abc"
    folder.mkdir()
    (folder / OWNER_FILE).touch()
    with monkeypatch.context() as patch:
        patch.setattr(os, "geteuid", lambda: 12_345)
        remove_abandoned()
    assert folder.exists()
    remove_abandoned()
    assert not folder.exists()


def test_a_removed_folder_cannot_be_held(temporary: Path) -> None:
    with pytest.raises(FileNotFoundError):
        hold_folder(temporary / "laneweave-gone")
