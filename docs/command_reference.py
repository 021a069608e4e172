"""The reference of the command line in COMMANDS.md, from the commands themselves."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from enum import Enum
from typing import Any

import typer

from laneweave.launch.cli.main import command_line

NAME = "laneweave"


def command_reference() -> str:
    """Return a section for each command: help text, usage, arguments and options."""
    program: Any = typer.main.get_command(command_line())
    context = program.make_context(NAME, [], resilient_parsing=True)
    return "\n\n".join(
        section
        for name in program.list_commands(context)
        for section in _sections(program.get_command(context, name), f"{NAME} {name}", context)
    )


def _sections(command: Any, name: str, parent: Any) -> Iterator[str]:
    """Yield the section of a command, or those of the commands of a group."""
    context = command.context_class(command, parent=parent, info_name=name.rpartition(" ")[2])
    if hasattr(command, "list_commands"):
        yield f"## {name}\n\n{_text(command.help)}"
        for inner in command.list_commands(context):
            for section in _sections(command.get_command(context, inner), f"{name} {inner}", context):
                yield f"#{section}"
        return
    parameters = [one for one in command.params if not getattr(one, "hidden", False)]
    arguments = [one for one in parameters if one.param_type_name == "argument"]
    options = [one for one in parameters if one.param_type_name == "option"]
    usage = " ".join([name, *(_metavar(one, context) for one in arguments)])
    parts = [f"## {name}", _text(command.help), f"```text\n{usage} [OPTIONS]\n```"]
    if arguments:
        rows = [[f"`{_metavar(one, context)}`", _text(one.help)] for one in arguments]
        parts.append(_table(["argument", "meaning"], rows))
    if options:
        rows = [[_option(one, context), _default(one), _text(one.help)] for one in options]
        parts.append(_table(["option", "default", "meaning"], rows))
    yield "\n\n".join(parts)


def _table(heads: list[str], rows: list[list[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines).replace("| --- ", "|---")


def _text(help_text: str | None) -> str:
    """Return a help text as one paragraph for a table or a section."""
    paragraphs = inspect.cleandoc(help_text or "").split("\n\n")
    return "<br>".join(" ".join(one.split()) for one in paragraphs).replace("|", "\\|")


def _metavar(parameter: Any, context: Any) -> str:
    return str(parameter.make_metavar(context))


def _option(option: Any, context: Any) -> str:
    names = "/".join([*option.opts, *option.secondary_opts])
    if not option.is_flag:
        names += f" {_metavar(option, context)}"
    shown = f"`{names}`".replace("|", "\\|")
    return f"{shown} (or `{option.envvar}`)" if option.envvar else shown


def _default(option: Any) -> str:
    value = option.default
    if isinstance(value, Enum):
        value = value.value
    if value is None or callable(value) or isinstance(value, (bool, list, tuple)) or value == "":
        return ""
    return f"`{value}`"
