"""The entry point of the package; it sets up signals before it loads the command line.

SIGINT is forwarded as SIGTERM. While OSQP solves, it installs its own handler for SIGINT in the
whole process, and loses signals that arrive late in a solution (measured: one in eight during
continuous solving). Therefore only one thread receives SIGINT, and forwards it.
"""

from __future__ import annotations

import os
import signal
import threading


def main() -> None:
    """Load and run the command line; Ctrl-C before it runs ends the process silently."""
    # Respect a parent that lets this process ignore SIGINT.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # Threads and processes that start later inherit the mask.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        threading.Thread(target=_forward_interrupts, name="interrupts", daemon=True).start()
    from laneweave.launch.cli import main as cli

    cli.main()


def _forward_interrupts() -> None:
    while True:
        signal.sigwait({signal.SIGINT})
        os.kill(os.getpid(), signal.SIGTERM)
