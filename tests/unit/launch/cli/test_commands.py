"""The table of commands: it says what the commands say, and using one imports no other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from typer.main import get_command

from laneweave.launch.cli.commands import COMMANDS
from laneweave.launch.cli.main import command_line
from support.commands import Here, python
from support.tables import for_each

ROOT = Path(__file__).resolve().parents[4]
CASE = ROOT / "docs" / "examples" / "case-study.json"
USE = """
import json, sys
from laneweave.launch.cli import main
status = main._status(sys.argv[1:])
sys.stderr.write(json.dumps([status, sorted(sys.modules)]))
"""
SLOW = {"numba", "scipy", "pyarrow", "matplotlib", "zenoh", "libsumo", "osqp", "psutil"}


def imported_by(*words: object) -> set[str]:
    """Run a command, and return the modules that its process has imported."""
    done = python(USE, *words)
    status, modules = json.loads(done.stderr)
    assert status == 0
    assert done.stdout
    return set(modules)


def commands_of(modules: set[str]) -> set[str]:
    """Return the modules of commands among some modules."""
    names = {f"laneweave.launch.cli.{entry.module}" for entry in COMMANDS.values()}
    return {name.rpartition(".")[2] for name in names & modules}


@for_each("name", COMMANDS)
def test_the_table_says_what_the_command_says(name: str) -> None:
    program: Any = get_command(command_line())

    command = program.commands[name]

    assert command.name == name
    assert " ".join(command.help.split("\n\n")[0].split()) == COMMANDS[name].help


def test_every_command_is_in_the_table() -> None:
    folder = ROOT / "launch" / "laneweave" / "launch" / "cli"
    modules = {path.stem for path in folder.glob("*_command*.py")}
    assert modules == {entry.module for entry in COMMANDS.values()}


def test_the_help_page_lists_all_commands(laneweave: Here) -> None:
    status, out, errors = laneweave("--help")

    assert (status, errors) == (0, [])
    words = " ".join(out.replace("│", " ").split())
    for name, entry in COMMANDS.items():
        assert f" {name} {entry.help} " in words


def test_a_misspelt_command_is_refused_with_a_suggestion(laneweave: Here) -> None:
    assert laneweave.refused("statsu") == "No such command 'statsu'. Did you mean 'status'?"


def test_the_help_page_imports_no_command() -> None:
    modules = imported_by("--help")

    assert commands_of(modules) == set()
    assert not modules & (SLOW | {"numpy", "cattrs", "structlog"})


def test_the_help_of_a_command_imports_no_other() -> None:
    assert commands_of(imported_by("certs", "init", "--help")) == {"deployment_commands"}


def test_a_plan_imports_what_it_needs() -> None:
    modules = imported_by("plan", CASE, "--solver", "tappa")

    assert commands_of(modules) == {"plan_command"}
    assert not modules & SLOW
