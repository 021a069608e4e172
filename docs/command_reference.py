"""The reference of the command line in COMMANDS.md, from the commands themselves."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import typer

from laneweave.launch.cli.main import command_line

NAME = "laneweave"


def command_reference() -> str:
    """Return a section for each command: what it does, its arguments and options."""
    program: Any = typer.main.get_command(command_line())
    context = program.make_context(NAME, [], resilient_parsing=True)
    return "\n\n".join(_sections(program, context, level=2))


def _sections(group: Any, context: Any, level: int) -> Iterator[str]:  # noqa: ANN401
    """Yield the sections of the commands of a group, and of the groups in it."""
    for name in group.list_commands(context):
        command = group.commands[name]  # `get_command` may know only the name and the help
        inner = type(context)(command, parent=context, info_name=name)
        parts = [f"{'#' * level} {inner.command_path}", inspect.cleandoc(command.help or "")]
        if hasattr(command, "list_commands"):
            yield "\n\n".join(parts)
            yield from _sections(command, inner, level + 1)
            continue
        parts.append(f"```text\n{command.get_usage(inner).removeprefix('Usage: ')}\n```")
        records = [parameter.get_help_record(inner) for parameter in command.params]
        rows = [f"| `{_cell(what)}` | {_cell(text)} |" for what, text in filter(None, records)]
        if rows:
            parts.append("\n".join(["| option | meaning |", "|---|---|", *rows]))
        yield "\n\n".join(parts)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
