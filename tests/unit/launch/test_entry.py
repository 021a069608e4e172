"""The entry point, interrupted while the command line loads."""

from __future__ import annotations

import signal
import subprocess
import sys

INTERRUPTED_WHILE_LOADING = """
import os, signal, sys
from laneweave.launch.entry import main

class Interruption:
    def find_spec(self, name, path=None, target=None):
        if name == "laneweave.launch.cli":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interruption())
sys.argv = ["laneweave", "--help"]
{before}
main()
"""


def run(before: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", INTERRUPTED_WHILE_LOADING.format(before=before)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_an_interrupt_while_it_loads_ends_it_without_a_word() -> None:
    done = run()
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_who_ignores_interrupts_goes_on_doing_so() -> None:
    done = run("signal.signal(signal.SIGINT, signal.SIG_IGN)")
    assert done.returncode == 0
    assert "Usage" in done.stdout
