"""The command line `laneweave`.

Exit status: 0 done; 1 the run failed or a promise was broken; 2 bad input, with one line on stderr
that names the field, the value and the allowed values.

Importing this module loads nothing, so that `main` sets up signals before anything else. SIGINT is
forwarded as SIGTERM: while OSQP solves, it installs its own handler for SIGINT in the whole
process, and loses signals that arrive late in a solution (measured: one in eight during continuous
solving). Therefore only one thread receives SIGINT, and forwards it.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import typer

TYPER_INTERRUPTED = 130
"""Exit status of typer after Ctrl-C."""
MISSING_SIM = "the simulation packages: install laneweave[sim]"
MISSING_WATCH = "the web server: install laneweave[watch]"
MISSING = {
    "distributed": "Dask: install laneweave[dask]",
    "osqp": "the solver of agents: install laneweave[agent]",
    "cryptography": "the package for certificates: install laneweave[certs]",
    "prometheus_client": "the package for metrics: install laneweave[metrics]",
    "starlette": MISSING_WATCH,
    "uvicorn": MISSING_WATCH,
    "websockets": MISSING_WATCH,
}
"""What to install for each missing package; `MISSING_SIM` for all others."""


def main() -> None:
    """Run the command line with the arguments of this process."""
    # Respect a parent that lets this process ignore SIGINT.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # Threads and processes that start later inherit the mask.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        threading.Thread(target=_forward_interrupts, name="interrupts", daemon=True).start()
    sys.exit(_status(sys.argv[1:]))


def _forward_interrupts() -> None:
    while True:
        signal.sigwait({signal.SIGINT})
        os.kill(os.getpid(), signal.SIGTERM)


def command_line() -> typer.Typer:
    """Return the command line with all commands."""
    import typer

    from laneweave.launch.cli import certs_commands, config_commands, role_commands, study_commands
    from laneweave.launch.cli.bench_command import bench
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
        *(roles.watch, status, studies.sweep, studies.report, simulate, bench),
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

    # Handle SIGTERM like Ctrl-C, so that files are completed and temporary folders removed. Roles
    # install their own handlers.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    log_to_terminal()
    command = typer.main.get_command(app)
    try:
        result: Any = command.main(
            arguments or ["--help"], prog_name="laneweave", standalone_mode=False
        )
    except (BadInputError, RefusedError) as error:
        return _refuse(str(error))
    except (typer.Abort, KeyboardInterrupt):
        sys.stderr.write("interrupted\n")
        return 1
    except typer.TyperException as error:
        # Unknown options and arguments; the library's own report takes several lines.
        return _refuse(getattr(error, "format_message", error.__str__)())
    except BrokenPipeError:
        return 1
    except CommandFailedError as error:
        sys.stderr.write(" ".join(str(error).split()) + "\n")
        return 1
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("laneweave"):
            raise
        missing = MISSING.get((error.name or "").partition(".")[0], MISSING_SIM)
        return _refuse(f"{error.name}: not installed; allowed: {missing}")
    if result == TYPER_INTERRUPTED:
        sys.stderr.write("interrupted\n")
        return 1
    return result if isinstance(result, int) else 0


def _refuse(line: str) -> int:
    sys.stderr.write(" ".join(line.split()) + "\n")
    return 2
