"""The command line `laneweave`.

Exit status: 0 success; 1 the run failed or violated a guarantee; 2 invalid input, reported on
stderr: one line for each error, with the field, its value and the allowed values.

Importing this module imports no other packages, so that `main` sets up signals first. One thread
receives SIGINT and forwards it as SIGTERM, because OSQP replaces the SIGINT handler of the process
while it solves, and loses signals that arrive late in a solve (measured: one in eight during
continuous solving).
"""

from __future__ import annotations

import errno
import gc
import signal
import sys
import threading
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import typer

TYPER_INTERRUPTED = 130
"""Exit status of typer after Ctrl-C."""
_DISK_FAILURES = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)
"""Errors of a disk that is full or fails."""
MAX_LINES = 20
"""Maximum number of errors of a file that are printed."""
SIM_HINT = "the simulation packages: install laneweave[sim]"
EXPORT_HINT = "the packages of this format: install laneweave[export]"
WATCH_HINT = "the web server: install laneweave[watch]"
INSTALL_HINTS = {
    "distributed": "Dask: install laneweave[dask]",
    "numba": "the planner: install laneweave[plan]",
    "scipy": "the numerical routines: install laneweave[plan], for agents laneweave[agent]",
    "osqp": "the quadratic-program solver: install laneweave[agent]",
    "cryptography": "the package for certificates: install laneweave[certs]",
    "prometheus_client": "the package for metrics: install laneweave[metrics]",
    "commonroad": EXPORT_HINT,
    "foxglove": EXPORT_HINT,
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
    # The interpreter would look for cyclic garbage among all objects, which takes 0.1 s.
    gc.freeze()
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
    """Return the command line with all commands; a command is imported when it is used."""
    import typer

    from laneweave.launch.cli.commands import LazyGroup, before_command

    app = typer.Typer(
        cls=LazyGroup,
        name="laneweave",
        help="Formation control with lane preference for connected and automated vehicles.",
        pretty_exceptions_enable=False,
    )
    app.callback()(before_command)
    return app


def _status(arguments: list[str]) -> int:
    """Run a command and return its exit status."""
    app = command_line()
    import typer

    from laneweave.launch.cli.usage_errors import usage_error
    from laneweave.protocol.errors import BadInputError, CommandFailedError, RefusedError
    from laneweave.protocol.runtime.processes import raise_interrupts, stop_signal_received

    # Handle SIGTERM and SIGHUP like Ctrl-C: complete files and remove temporary folders. Roles
    # install their own handlers.
    raise_interrupts(signal.SIGTERM, signal.SIGHUP)
    command = typer.main.get_command(app)
    try:
        result: Any = command.main(
            arguments or ["--help"], prog_name="laneweave", standalone_mode=False
        )
    except BadInputError as error:
        return _bad_input(*map(str, error.problems))
    except RefusedError as error:
        return _bad_input(str(error))
    except (typer.Abort, KeyboardInterrupt):
        return _interrupted()
    except typer.TyperException as error:
        # Unknown option or argument; print one line instead of typer's multi-line report.
        return _bad_input(usage_error(error))
    except BrokenPipeError:
        return 1
    except CommandFailedError as error:
        if stop_signal_received():
            # The signal has ended a program that this command was using, too.
            return _interrupted()
        sys.stderr.write(" ".join(str(error).split()) + "\n")
        return 1
    except (OSError, ModuleNotFoundError) as error:
        if isinstance(error, OSError) and error.errno in _DISK_FAILURES:
            sys.stderr.write(f"{error.filename or 'a file'}: {error.strerror}\n")
            return 1
        problem = _problem(error)
        if problem is None:
            raise
        return _bad_input(problem)
    if result == TYPER_INTERRUPTED:
        return _interrupted()
    return result if isinstance(result, int) else 0


def _problem(error: OSError | ModuleNotFoundError) -> str | None:
    """Return what the user can mend: a path or a missing package; None: an error in laneweave."""
    from laneweave.protocol.errors import BadInputError

    if isinstance(error, OSError):
        if error.errno not in (errno.ENAMETOOLONG, errno.EACCES):
            return None
        allowed = f"an accessible file or folder ({error.strerror})"
        return str(BadInputError("file", error.filename, allowed))
    name = error.name or ""
    if name.startswith("laneweave"):
        return None
    hint = INSTALL_HINTS.get(name.partition(".")[0], SIM_HINT)
    return f"{name}: not installed ({hint})"


def _interrupted() -> int:
    sys.stderr.write("interrupted\n")
    return 1


def _bad_input(*lines: str) -> int:
    for line in lines[:MAX_LINES]:
        sys.stderr.write(" ".join(line.split()) + "\n")
    if len(lines) > MAX_LINES:
        sys.stderr.write(f"and {len(lines) - MAX_LINES} more errors\n")
    return 2
