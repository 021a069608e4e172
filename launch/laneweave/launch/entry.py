"""The entry point of the package: it takes its time to load, and may be interrupted meanwhile."""

from __future__ import annotations

import signal


def main() -> None:
    """Load the command line and run it; Ctrl-C before it runs ends the process without a word."""
    interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if interruptible:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from laneweave.launch import cli  # noqa: PLC0415 (loads nearly everything)

    if interruptible:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    cli.main()
