"""The command line `laneweave`.

Exit status: 0 success; 1 the run failed or violated a guarantee; 2 invalid input, reported in one
line on stderr with the field, its value and the allowed values.

Importing this module imports no other packages, so that `main` sets up signals first. One thread
receives SIGINT and forwards it as SIGTERM, because OSQP replaces the SIGINT handler of the process
while it solves, and loses signals that arrive late in a solve (measured: one in eight during
continuous solving).
"""

from __future__ import annotations

import signal
import sys
import threading
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import typer

TYPER_INTERRUPTED = 130
"""Exit status of typer after Ctrl-C."""
SIM_HINT = "the simulation packages: install laneweave[sim]"
WATCH_HINT = "the web server: install laneweave[watch]"
INSTALL_HINTS = {
    "distributed": "Dask: install laneweave[dask]",
    "numba": "the planner: install laneweave[plan]",
    "scipy": "the numerical routines: install laneweave[plan], for agents laneweave[agent]",
    "osqp": "the quadratic-program solver: install laneweave[agent]",
    "cryptography": "the package for certificates: install laneweave[certs]",
    "prometheus_client": "the package for metrics: install laneweave[metrics]",
    "starlette": WATCH_HINT,
    "uvicorn": WATCH_HINT,
    "websockets": WATCH_HINT,
}
"""Installation hint for each missing package; `SIM_HINT` for all others."""


def main() -> None:
    """Run the command line with the arguments of this process."""
    # If the parent made this process ignore SIGINT, keep ignoring it.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # Threads and processes that start later inherit the mask.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        threading.Thread(target=_forward_interrupts, name="interrupts", daemon=True).start()
    try:
        status = _status(sys.argv[1:])
    except KeyboardInterrupt:  # before or after the command itself
        status = _interrupted()
    # A second Ctrl-C must not interrupt the end of this process, which would print a traceback.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    sys.exit(status)


def _forward_interrupts() -> None:
    # Python handles signals in the main thread. One that the kernel delivers to this thread would
    # not wake the main thread from a system call.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGHUP})
    main_thread = threading.main_thread().ident
    while main_thread is not None:
        signal.sigwait({signal.SIGINT})
        signal.pthread_kill(main_thread, signal.SIGTERM)


def command_line() -> typer.Typer:
    """Return the command line with all commands."""
    import typer

    from laneweave.launch.cli import certs_commands, config_commands, role_commands, study_commands
    from laneweave.launch.cli.bench_command import bench
    from laneweave.launch.cli.corridor_command import corridor
    from laneweave.launch.cli.plan_command import plan
    from laneweave.launch.cli.run_command import run
    from laneweave.launch.cli.simulate_command import simulate
    from laneweave.launch.cli.status_command import status

    app = typer.Typer(
        name="laneweave",
        help="Formation control with lane preference for connected and automated vehicles.",
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    roles, studies = role_commands, study_commands
    for command in (
        *(run, plan, roles.router, roles.ping, roles.coordinator, roles.agent, roles.bridge),
        *(roles.watch, status, studies.sweep, studies.report, simulate, bench, corridor),
    ):
        app.command()(command)
    app.add_typer(certs_commands.app, name="certs")
    app.add_typer(config_commands.app, name="config")
    return app


def _status(arguments: list[str]) -> int:
    """Run a command and return its exit status."""
    app = command_line()
    import typer

    from laneweave.launch.run.logs import log_to_terminal
    from laneweave.protocol.errors import BadInputError, CommandFailedError, RefusedError
    from laneweave.protocol.runtime.processes import raise_interrupts, stop_signal_received

    # Handle SIGTERM and SIGHUP like Ctrl-C: complete files and remove temporary folders. Roles
    # install their own handlers.
    raise_interrupts(signal.SIGTERM, signal.SIGHUP)
    log_to_terminal()
    command = typer.main.get_command(app)
    try:
        result: Any = command.main(
            arguments or ["--help"], prog_name="laneweave", standalone_mode=False
        )
    except (BadInputError, RefusedError) as error:
        return _bad_input(str(error))
    except (typer.Abort, KeyboardInterrupt):
        return _interrupted()
    except typer.TyperException as error:
        # Unknown option or argument; print one line instead of typer's multi-line report.
        return _bad_input(getattr(error, "format_message", error.__str__)())
    except BrokenPipeError:
        return 1
    except CommandFailedError as error:
        if stop_signal_received():
            # The signal has ended a program that this command was using, too.
            return _interrupted()
        sys.stderr.write(" ".join(str(error).split()) + "\n")
        return 1
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("laneweave"):
            raise
        hint = INSTALL_HINTS.get((error.name or "").partition(".")[0], SIM_HINT)
        return _bad_input(f"{error.name}: not installed ({hint})")
    if result == TYPER_INTERRUPTED:
        return _interrupted()
    return result if isinstance(result, int) else 0


def _interrupted() -> int:
    sys.stderr.write("interrupted\n")
    return 1


def _bad_input(line: str) -> int:
    sys.stderr.write(" ".join(line.split()) + "\n")
    return 2
