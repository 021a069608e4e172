"""Commands that tests run to their end, in a process of their own or in this one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from attrs import frozen
from typer.main import get_command

from laneweave.launch.cli import main as cli

LANEWEAVE = str(Path(sys.executable).with_name("laneweave"))


def run(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:  # noqa: ANN401
    """Run a command; its output is text."""
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
    return subprocess.run(list(map(str, words)), text=True, timeout=240, check=False, **streams)


def laneweave(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run `laneweave ARGUMENTS`."""
    return run(LANEWEAVE, *arguments)


def python(program: str, *arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:  # noqa: ANN401
    """Run a program in an interpreter of its own."""
    return run(sys.executable, "-c", program, *arguments, **options)


def loads(module: str, other: str) -> bool:
    """Return whether the import of a module imports another one, too."""
    path = [entry for entry in sys.path if entry]
    program = (
        f"import sys; sys.path[:0] = {path!r}; import {module}; print({other!r} in sys.modules)"
    )
    done = python(program)
    assert done.returncode == 0, done.stderr
    return done.stdout == "True\n"


def parameters(words: list[str]) -> dict[str, Any]:
    """Parse a command line as the command itself does, and return its options."""
    group: Any = get_command(cli.command_line())
    command = group.commands[words[0]]
    words = words[1:]
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
    found: dict[str, Any] = command.make_context("laneweave", list(words)).params
    return found


@frozen
class Here:
    """Runs `laneweave ARGUMENTS` in this process."""

    _capsys: pytest.CaptureFixture[str]

    def __call__(self, *arguments: object) -> tuple[int, str, list[str]]:
        """Return the exit status, the output, and the lines of stderr."""
        status = cli._status(list(map(str, arguments)))
        written = self._capsys.readouterr()
        return status, written.out, written.err.splitlines()

    def refused(self, *arguments: object) -> str:
        """Return the one line with which a command is refused."""
        status, out, errors = self(*arguments)
        assert (status, out, len(errors)) == (2, "", 1), errors
        return errors[0]
