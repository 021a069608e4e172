"""Commands in processes of their own, forked from one that has loaded the package already.

Loading takes half a second, and hundreds of refusals are to be seen. What happens after it is what
happens in a process that was started afresh, to its end and its exit status.

Run as a program, this is the process that forks: a line of JSON on its standard input for each
command, and its exit status on its standard output.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

import psutil
from attrs import define

HELD = -1
"""Told instead of a status when a command ended by a signal."""


@define
class Loaded:
    """The process that forks, as seen by tests; started when it is needed first."""

    folder: Path
    """For what commands write to their standard output and error."""
    _process: subprocess.Popen[str] | None = None

    def run(
        self,
        arguments: Sequence[str],
        cwd: Path,
        environment: Mapping[str, str],
        within_s: float,
    ) -> tuple[int, str, str]:
        """Run `laneweave ARGUMENTS` to its end; return its status and what it wrote."""
        out, err = self.folder / "out", self.folder / "err"
        order = {"arguments": arguments, "cwd": str(cwd), "environment": dict(environment)}
        process = self._running()
        assert process.stdin is not None
        assert process.stdout is not None
        watchdog = threading.Timer(within_s, self.close)
        watchdog.start()
        try:
            process.stdin.write(json.dumps(order | {"out": str(out), "err": str(err)}) + "\n")
            process.stdin.flush()
            told = process.stdout.readline()
        finally:
            watchdog.cancel()
        written = out.read_text(encoding="utf-8"), err.read_text(encoding="utf-8")
        assert told, f"still running after {within_s:g} s: {arguments}\n{written}"
        assert _group(process.pid) == [process.pid], f"left running by {arguments}"
        return int(told), *written

    def close(self) -> None:
        """Kill the process that forks, and the command that may be running."""
        if self._process is not None:
            process, self._process = self._process, None
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, __file__],
                env=os.environ | {"COLUMNS": "120"},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
        return self._process


def _group(leader: int) -> list[int]:
    """Return the processes of a group; one that was only forked does not carry a test's mark."""
    members = []
    for pid in psutil.pids():
        with contextlib.suppress(ProcessLookupError):
            if os.getpgid(pid) == leader:
                members.append(pid)
    return members


# --- the process that forks -------------------------------------------------------------------


def _serve() -> None:
    """Fork for each line; only children come back."""
    gc.freeze()  # else each child looks through all that is loaded as it ends
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            _become(json.loads(line))
            return
        _, status = os.waitpid(child, 0)
        print(os.WEXITSTATUS(status) if os.WIFEXITED(status) else HELD, flush=True)  # noqa: T201
    sys.exit()


def _become(order: dict[str, object]) -> None:
    """Be as a process that was started for this command."""
    os.chdir(str(order["cwd"]))
    environment, arguments = order["environment"], order["arguments"]
    assert isinstance(environment, dict)
    assert isinstance(arguments, list)
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = None  # it may have been looked up
    for number, name in enumerate((os.devnull, str(order["out"]), str(order["err"]))):
        flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC
        os.dup2(os.open(name, flags, 0o600), number)
    sys.argv = ["laneweave", *arguments]


if __name__ == "__main__":
    import laneweave.agents.process
    import laneweave.coordinator.process
    import laneweave.launch.cli.main
    import laneweave.launch.run.simulated_run
    import laneweave.sim_bridge.process  # noqa: F401
    from laneweave.launch.cli.entry import main

    _serve()
    main()
