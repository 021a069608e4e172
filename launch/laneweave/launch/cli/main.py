"""The command line `laneweave`.

Exit status: 0 done; 1 the run failed or a promise was broken; 2 bad input, with one line on stderr
that names the field, the value and the allowed values.
"""

from __future__ import annotations

import signal
import sys
from typing import Any

import typer

from laneweave.launch.cli import certs_commands, config_commands
from laneweave.launch.cli.bench_command import bench
from laneweave.launch.cli.plan_command import plan
from laneweave.launch.cli.role_commands import agent, bridge, coordinator, ping, router, watch
from laneweave.launch.cli.run_command import run
from laneweave.launch.cli.simulate_command import simulate
from laneweave.launch.cli.status_command import status
from laneweave.launch.cli.study_commands import report, sweep
from laneweave.launch.run.logs import log_to_terminal
from laneweave.protocol.errors import BadInputError, CommandFailedError, RefusedError

app = typer.Typer(
    name="laneweave",
    help="Formation control with lane preference for connected and automated vehicles.",
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (
    *(run, plan, router, ping, coordinator, agent, bridge, watch, status, sweep, report),
    *(simulate, bench),
):
    app.command()(command)
app.add_typer(certs_commands.app, name="certs")
app.add_typer(config_commands.app, name="config")

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
    # Handle SIGTERM like Ctrl-C, so that files are completed and temporary folders removed. Roles
    # install their own handlers.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(_status(sys.argv[1:]))


def _status(arguments: list[str]) -> int:
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
