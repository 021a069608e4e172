"""The entry point of the package: signals first, since it takes its time to load.

Ctrl-C is taken as SIGTERM is. OSQP puts its own handler for SIGINT in place while it solves, for
the whole process, and forgets the signal when it comes too late in a solution (measured: one in
eight while solving without a pause). So no thread ever receives it but one, which passes it on.
"""

from __future__ import annotations

import os
import signal
import threading


def main() -> None:
    """Load the command line and run it; Ctrl-C before it runs ends the process without a word."""
    # Who is told to ignore SIGINT goes on to do so.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # Threads and processes that are started from now on inherit it.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        threading.Thread(target=_pass_interrupts_on, name="interrupts", daemon=True).start()
    from laneweave.launch.cli import main as cli

    cli.main()


def _pass_interrupts_on() -> None:
    while True:
        signal.sigwait({signal.SIGINT})
        os.kill(os.getpid(), signal.SIGTERM)
