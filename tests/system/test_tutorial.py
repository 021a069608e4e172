"""The commands and programs of the tutorial and of the guide for Python, as they are printed."""

from __future__ import annotations

import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

import pytest

from support.harness import END_S, RUN_S, Lab

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```(sh|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SET_UP = ["make install", "source .venv/bin/activate"]
"""Commands that have been carried out where tests run."""


def blocks(document: str) -> list[tuple[str, str]]:
    """Return the language and the text of each block, in order."""
    text = (ROOT / "docs" / document).read_text(encoding="utf-8")
    return BLOCK.findall(text)


@pytest.fixture
def clone(lab: Lab) -> Path:
    """A folder with what the documents use of a clone."""
    (lab.folder / "scenarios").symlink_to(ROOT / "scenarios")
    return lab.folder


def watch(lab: Lab, *arguments: str) -> None:
    """Open the page of a command that serves it until Ctrl-C."""
    process = lab.start("watch", *arguments, "--listen", "127.0.0.1:0")
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    with urlopen(address, timeout=END_S) as page:  # noqa: S310
        assert b"laneweave" in page.read()
    process.send_signal(signal.SIGINT)
    assert lab.finish(process, END_S).complaints == []


def run_program(lab: Lab, text: str) -> str:
    """Run a program of a document, and return what it prints."""
    program = lab.path("program.py", text)
    done = subprocess.run(
        [sys.executable, program],
        cwd=lab.folder,
        env=lab.environment | {"MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=RUN_S,
        check=False,
    )
    assert done.returncode == 0, f"{text}\n{done.stderr}"
    return done.stdout


def follow(lab: Lab, document: str) -> list[str]:
    """Carry out all blocks of a document; return what its programs print."""
    printed = []
    for language, text in blocks(document):
        if language == "python":
            printed.append(run_program(lab, text))
            continue
        for command in text.splitlines():
            program, *arguments = shlex.split(command, comments=True)
            if command in SET_UP:
                continue
            assert program == "laneweave", command
            if arguments[0] == "watch":
                watch(lab, *arguments[1:])
            else:
                ended = lab.run(*arguments)
                assert ended.status == 0, (command, ended)
    return printed


@pytest.mark.full
def test_the_tutorial(lab: Lab, clone: Path) -> None:
    first, speeds, changes, volumes = follow(lab, "TUTORIAL.md")

    assert "91 vehicles have left the road" in first
    assert speeds.startswith("minute 0: [15")
    assert (clone / "mean-speed.png").stat().st_size > 10_000
    (twice,) = re.findall(r"^twice: (.+)$", changes, re.MULTILINE)
    assert len(twice.split(", ")) > 5
    assert [line.split()[0] for line in volumes.splitlines()] == ["1000", "1600"]


@pytest.mark.slow
@pytest.mark.more
def test_the_guide_of_exports(lab: Lab, clone: Path) -> None:
    speeds, changes, energy, _ = follow(lab, "EXPORT.md")

    assert speeds.startswith("minute 0: [")
    assert changes.startswith("lane changes: vehicles [(1, ")
    assert [line.partition(":")[0] for line in energy.splitlines()] == [
        "petrol", "diesel", "electric", "HBEFA4/PC_petrol_Euro-4"
    ]  # fmt: skip
    assert (clone / "time-space.png").stat().st_size > 10_000
    found = {path.name for path in (clone / "runs" / "analysed" / "export").iterdir()}
    assert {"fcd.xml", "fcd.road.net.xml", "run.mcap", "commonroad.xml", "columns.csv"} <= found


@pytest.mark.slow
@pytest.mark.usefixtures("clone")
@pytest.mark.more
def test_the_guide_for_python(lab: Lab) -> None:
    run, read, plan = follow(lab, "PYTHON.md")

    assert run.endswith(" 0\n")
    assert "entered" in read
    assert plan.startswith("optimal 7\n")
