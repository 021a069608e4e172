"""The command line `laneweave`.

Exit status: 0 success; 1 the run failed or violated a guarantee; 2 invalid input, reported in one
line on stderr with the field, its value and the allowed values.

Importing this module imports no other packages, so that `main` sets up signals first. One thread
receives SIGINT and forwards it as SIGTERM, because OSQP replaces the SIGINT handler of the process
while it solves, and loses signals that arrive late in a solve (measured: one in eight during
continuous solving).
"""

from __future__ import annotations

import gc
import os
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
    status = _status(sys.argv[1:])
    # A second Ctrl-C must not interrupt the end of this process, which would print a traceback.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    # The interpreter would look for cyclic garbage among all objects, which takes 0.1 s.
    gc.freeze()
    sys.exit(status)


def _forward_interrupts() -> None:
    while True:
        signal.sigwait({signal.SIGINT})
        os.kill(os.getpid(), signal.SIGTERM)


def command_line() -> typer.Typer:
    """Return the command line with all commands; a command is imported when it is used."""
    import typer

    from laneweave.launch.cli.commands import LazyGroup

    app = typer.Typer(
        cls=LazyGroup,
        name="laneweave",
        help="Formation control with lane preference for connected and automated vehicles.",
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    app.callback()(_before_command)
    return app


def _before_command() -> None:
    from laneweave.launch.run.logs import log_to_terminal

    log_to_terminal()


def _status(arguments: list[str]) -> int:
    """Run a command and return its exit status."""
    app = command_line()
    import typer

    from laneweave.protocol.errors import BadInputError, CommandFailedError, RefusedError

    # Handle SIGTERM like Ctrl-C: complete files and remove temporary folders. Roles install
    # their own handlers.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    command = typer.main.get_command(app)
    try:
        result: Any = command.main(
            arguments or ["--help"], prog_name="laneweave", standalone_mode=False
        )
    except (BadInputError, RefusedError) as error:
        return _bad_input(str(error))
    except (typer.Abort, KeyboardInterrupt):
        sys.stderr.write("interrupted\n")
        return 1
    except typer.TyperException as error:
        # Unknown option or argument; print one line instead of typer's multi-line report.
        return _bad_input(getattr(error, "format_message", error.__str__)())
    except BrokenPipeError:
        return 1
    except CommandFailedError as error:
        sys.stderr.write(" ".join(str(error).split()) + "\n")
        return 1
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("laneweave"):
            raise
        hint = INSTALL_HINTS.get((error.name or "").partition(".")[0], SIM_HINT)
        return _bad_input(f"{error.name}: not installed ({hint})")
    if result == TYPER_INTERRUPTED:
        sys.stderr.write("interrupted\n")
        return 1
    return result if isinstance(result, int) else 0


def _bad_input(line: str) -> int:
    sys.stderr.write(" ".join(line.split()) + "\n")
    return 2
