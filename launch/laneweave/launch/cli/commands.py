"""Table of the commands, and the group that imports a command's module when it is used.

`laneweave --help` and the completion of command names use the table only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Annotated, Any, NamedTuple, cast

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command


class CommandEntry(NamedTuple):
    """A command, or a group of commands, and where to find it."""

    module: str
    """Name of the module in this package."""
    attribute: str
    """Function of the command, or `typer.Typer` of the group."""
    help: str
    """First paragraph of its help page."""

    def load(self, name: str) -> Any:  # noqa: ANN401 (a private class of typer)
        """Import the command."""
        found = getattr(import_module(f"{__package__}.{self.module}"), self.attribute)
        if not isinstance(found, typer.Typer):
            app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
            app.command(name)(found)
            found = app
        command = get_command(found)
        command.name = name
        return command


COMMANDS = {
    "run": CommandEntry(
        "run_command", "run", "Run a scenario on this machine, and write the results to a folder."
    ),
    "plan": CommandEntry(
        "plan_command",
        "plan",
        "Answer one plan request, in this process or with a running coordinator.",
    ),
    "router": CommandEntry("role_commands", "router", "Run the Zenoh router of a deployment."),
    "ping": CommandEntry(
        "role_commands", "ping", "Check the health of a router: it must accept a session."
    ),
    "coordinator": CommandEntry(
        "role_commands", "coordinator", "Run a coordinator, which also answers plan requests."
    ),
    "agent": CommandEntry(
        "role_commands",
        "agent",
        "Run the agents of the named vehicles, or of all announced vehicles.",
    ),
    "bridge": CommandEntry("role_commands", "bridge", "Run the simulated world of a deployment."),
    "watch": CommandEntry(
        "role_commands",
        "watch",
        "Serve a page that shows the road of a deployment or of a recorded run, until Ctrl-C.",
    ),
    "status": CommandEntry(
        "status_command",
        "status",
        "Listen to a deployment and print its state; exit with status 1 if it is unhealthy.",
    ),
    "road": CommandEntry(
        "road_command",
        "road",
        "Close parts of lanes of a running deployment, and open them again.",
    ),
    "faults": CommandEntry("faults_command", "faults", "Inject faults into a deployment."),
    "sweep": CommandEntry(
        "study_commands",
        "sweep",
        "Run methods x volumes x seeds in parallel, in virtual time; skip finished runs.",
    ),
    "tune": CommandEntry(
        "tune_command",
        "tune",
        "Find a method's best settings for a road by random search, in virtual time.",
    ),
    "sensitivity": CommandEntry(
        "sensitivity_command",
        "sensitivity",
        "Change one setting at a time, in virtual time, and write a page with a tornado chart.",
    ),
    "report": CommandEntry(
        "study_commands",
        "report",
        "Write figures and a page for each finished run, and for a sweep or several runs together.",
    ),
    "explain": CommandEntry(
        "explain_command",
        "explain",
        "Tell what happened to a vehicle in a run, and why it missed its lane.",
    ),
    "export": CommandEntry(
        "export_command",
        "export",
        "Write a recorded run in an open format, and print the names of the files.",
    ),
    "repair": CommandEntry(
        "study_commands",
        "repair",
        "Complete the files of runs whose process was killed.",
    ),
    "simulate": CommandEntry(
        "simulate_command",
        "simulate",
        "Simulate and check runs with far more faults than occur in practice.",
    ),
    "bench": CommandEntry(
        "bench_command",
        "bench",
        "Benchmark runs with 30, 60 and 90 vehicles, plans for 6 to 36 vehicles, or the tracker.",
    ),
    "corridor": CommandEntry(
        "corridor_command",
        "corridor",
        "List what can be a corridor in a SUMO simulation, or describe one.",
    ),
    "compile": CommandEntry(
        "plan_command",
        "compile_solvers",
        "Compile the solvers that need it, which otherwise happens when they are first used.",
    ),
    "certs": CommandEntry("deployment_commands", "certs", "Make test certificates."),
    "config": CommandEntry("deployment_commands", "config", "Check a configuration."),
}
"""All commands in the order of the help page."""


def _print_version(value: bool) -> None:
    if value:
        from importlib.metadata import version

        typer.echo(f"laneweave {version('laneweave')}")
        raise typer.Exit


def before_command(
    _: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version, and exit."
        ),
    ] = False,
) -> None:
    """Formation control with lane preference for connected and automated vehicles."""
    from laneweave.launch.run.logs import log_to_terminal

    log_to_terminal()


class LazyGroup(TyperGroup):
    """Group of the commands in `COMMANDS`."""

    def __init__(self, **settings: Any) -> None:  # noqa: ANN401 (of `TyperGroup`)
        """Make the group; see `TyperGroup`."""
        super().__init__(**settings)
        self.commands = cast("Any", _Commands())

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401, ARG002
        """Return the names in the order of the help page."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401, ARG002
        """Return the name and help of a command, for the help page and completion."""
        entry = COMMANDS.get(cmd_name)
        return None if entry is None else TyperCommand(cmd_name, help=entry.help)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:  # noqa: ANN401
        """Return the command to run, with its name and arguments."""
        name, found, rest = super().resolve_command(ctx, args)
        return name, found and self.commands[args[0]], rest


class _Commands(Mapping[str, Any]):
    """The commands by name, each imported at the first access."""

    def __init__(self) -> None:
        self._loaded: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401
        if name not in self._loaded:
            self._loaded[name] = COMMANDS[name].load(name)
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __len__(self) -> int:
        return len(COMMANDS)
