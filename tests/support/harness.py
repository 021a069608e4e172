"""Real processes under test: started in a group of their own, found again by a mark, cleaned up.

Every process that a test starts, and every process that one starts in turn, carries the test's
mark in its environment. So a test can tell what is left of it, whoever the parents are by then.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet as pq
from attrs import define, field, frozen

from laneweave.launch import cli
from laneweave.launch.cli.main import main
from support.commands import LANEWEAVE
from support.waiting import wait_until

PIPES = {
    "stdin": subprocess.DEVNULL,
    "stdout": subprocess.PIPE,
    "stderr": subprocess.PIPE,
}
MARK = "LANEWEAVE_TEST_MARK"
LOADED = (
    *(
        f"laneweave.launch.cli.{path.stem}"
        for path in Path(cli.__file__).parent.glob("*_command*.py")
    ),
    "laneweave.launch.run.simulated_run",
    *(f"laneweave.{role}.process" for role in ("agents", "coordinator", "sim_bridge")),
)
"""What commands load."""
NOTES = ("endpoint: ", "live page: ", "slower than real time: ")
"""Beginnings of the lines with which a run over Zenoh describes itself."""
RUN_S = 240.0
"""Nothing here takes a tenth of this; it only guards against hanging."""
END_S = 90.0
"""How long processes that were told to end may take."""

ROAD = """\
schema = "laneweave.scenario/1"

[road]
s2_m = 100.0
s3_m = 450.0
"""
SHORT_ROAD = """\
schema = "laneweave.scenario/1"

[road]
s2_m = 60.0
s3_m = 240.0
"""
"""Room for a few moves."""
DEMAND = ("--volume", "1300", "--duration", "14", "--seed", "1")
"""With `ROAD`: lane sorting begins while vehicles still arrive."""


@frozen
class Ended:
    """Exit status and output of a process."""

    status: int
    out: str
    err: str

    @property
    def complaints(self) -> list[str]:
        """Lines of stderr without warnings, which a slow machine causes, and without notes."""
        lines = [line for line in self.err.splitlines() if not line.startswith(NOTES)]
        return [line for line in lines if "[warning" not in line and " WARN " not in line]


def _become(
    arguments: list[str], folder: Path, environment: dict[str, str], written: list[Path]
) -> None:
    """Run a command in this process, which was forked for it."""
    os.setsid()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = None  # it may have been looked up
    for number, path in enumerate(written, start=1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), number)
    sys.argv = ["laneweave", *arguments]

    main()


def _group(leader: int | None) -> list[int]:
    """Return the processes of a group; one that was only forked does not carry a test's mark."""
    members = []
    for pid in psutil.pids():
        with contextlib.suppress(ProcessLookupError):
            if os.getpgid(pid) == leader:
                members.append(pid)
    return members


@define
class Lab:
    """Starts processes for one test and knows them again."""

    folder: Path
    sockets: Path
    """Temporary folder of the processes; its path is short, since sockets are made in it."""
    mark: str = field(factory=lambda: uuid.uuid4().hex)
    _started: list[subprocess.Popen[str]] = field(factory=list)

    def start(self, *arguments: object, **environment: str) -> subprocess.Popen[str]:
        """Start `laneweave ARGUMENTS` as the leader of a new process group."""
        return self.start_with({}, *arguments, **environment)

    def start_with(
        self, options: Mapping[str, Any], *arguments: object, **environment: str
    ) -> subprocess.Popen[str]:
        """As `start`, with options of `subprocess.Popen`.

        `run` draws a report only if it is told to, since this takes longer than a short run.
        """
        if arguments[0] == "run" and "--report" not in arguments:
            arguments = (*arguments, "--no-report")
        process = subprocess.Popen(
            [LANEWEAVE, *map(str, arguments)],
            cwd=self.folder,
            env=self.environment | environment,
            text=True,
            start_new_session=True,
            **PIPES | dict(options),
        )
        self._started.append(process)
        return process

    @property
    def environment(self) -> dict[str, str]:
        """What the processes of this test see."""
        return dict(os.environ) | {MARK: self.mark, "TMPDIR": str(self.sockets), "COLUMNS": "120"}

    def finish(self, process: subprocess.Popen[str], within_s: float = RUN_S) -> Ended:
        """Wait for a process that was started here."""
        try:
            out, err = process.communicate(timeout=within_s)
        except subprocess.TimeoutExpired:
            self.kill_rest()
            out, err = process.communicate()
            message = f"still running after {within_s:g} s: {process.args!r}\n{out}\n{err}"
            raise AssertionError(message) from None
        return Ended(process.returncode, out, err)

    def run(self, *arguments: object, within_s: float = RUN_S, **environment: str) -> Ended:
        """Run `laneweave ARGUMENTS` to its end; nothing may be left of it."""
        ended = self.finish(self.start(*arguments, **environment), within_s)
        self.check_nothing_left()
        return ended

    def run_forked(self, *arguments: object, within_s: float = END_S, alone: bool = True) -> Ended:
        """As `run`, in a process forked from one that has loaded the package, which is quicker.

        What happens after loading is what happens in a process that was started afresh. If other
        processes of this test run, the command is not `alone`.
        """
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["__main__", *LOADED])
        written = [self.folder.with_name(f"{self.mark}.{name}") for name in ("out", "err")]
        process = context.Process(
            target=_become, args=(list(map(str, arguments)), self.folder, self.environment, written)
        )
        process.start()
        process.join(within_s)
        status, group = process.exitcode, _group(process.pid)
        for pid in group:
            os.kill(pid, signal.SIGKILL)
        assert group == [], f"left running after {within_s:g} s by {arguments}"
        assert status is not None
        if alone:
            self.check_nothing_left()
        return Ended(status, *(path.read_text(encoding="utf-8") for path in written))

    # --- what is running ----------------------------------------------------------------------

    def processes(self) -> list[psutil.Process]:
        """Return all processes of this test."""
        return [process for process in psutil.process_iter() if self._is_ours(process)]

    def roles(self) -> dict[str, int]:
        """Return the process ids of the roles that `laneweave run` has started, by name."""
        found = {}
        for process in self.processes():
            with contextlib.suppress(OSError):
                name = Path(f"/proc/{process.pid}/comm").read_text(encoding="utf-8").strip()
                found[name] = process.pid
        return found

    def wait_until(self, condition: Callable[[], bool], within_s: float = RUN_S) -> None:
        """Wait for a condition."""
        wait_until(condition, within_s)

    def check_nothing_left(self) -> None:
        """Check that no process of this test runs any more, and no temporary file is there."""
        wait_until(lambda: not self.processes(), END_S, self.processes)
        assert list(self.sockets.iterdir()) == []

    def kill_rest(self) -> list[str]:
        """Kill what is left of this test, and say what that was."""
        rest = self.processes()
        for process in rest:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        for started in self._started:
            started.wait(END_S)
            for stream in (started.stdout, started.stderr):
                if stream is not None:
                    stream.close()
        return [str(process) for process in rest]

    def _is_ours(self, process: psutil.Process) -> bool:
        try:
            return process.environ().get(MARK) == self.mark
        except (psutil.Error, OSError):
            return False  # a zombie, or not ours to look at

    # --- what a run leaves --------------------------------------------------------------------

    def path(self, name: str, text: str) -> Path:
        """Write a file in the test's folder and return its path."""
        path = self.folder / name
        path.write_text(text, encoding="utf-8")
        return path

    @property
    def router_endpoint(self) -> str:
        """Endpoint of the router of the run that is under way."""
        (socket,) = self.sockets.glob("laneweave-*/router.sock")
        return f"unixsock-stream/{socket}"


@contextlib.contextmanager
def laboratory(folder: Path) -> Iterator[Lab]:
    """Give processes a place; a process that is left at the end is an error."""
    sockets = Path(tempfile.mkdtemp(prefix="lw-"))
    lab = Lab(folder, sockets)
    try:
        yield lab
    finally:
        left = lab.kill_rest()
        shutil.rmtree(sockets, ignore_errors=True)
    assert not left


def interrupt(process: subprocess.Popen[str], number: signal.Signals) -> None:
    """Send a signal to a process's whole group, as a terminal does."""
    os.killpg(process.pid, number)


def summary(folder: Path) -> dict[str, Any]:
    """Return a run's summary; `NaN` and `Infinity` are not JSON."""
    text = (folder / "summary.json").read_text(encoding="utf-8")
    found: dict[str, Any] = json.loads(text, parse_constant=_refuse)
    return found


def _refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


def events(folder: Path, kind: str | None = None) -> list[dict[str, Any]]:
    """Return a run's events, of one kind or all; a run may still be writing the last line."""
    return [
        event for event in _json_lines(folder / "events.jsonl") if kind in (None, event["kind"])
    ]


def plans(folder: Path) -> list[dict[str, Any]]:
    """Return the events that tell of a plan, of a formation or of the whole stream."""
    return [event for event in events(folder) if event["kind"] in ("plan-made", "stream-planned")]


def log_lines(folder: Path) -> list[dict[str, Any]]:
    """Return what the processes of a run logged."""
    return list(_json_lines(folder / "log.jsonl"))


def _json_lines(path: Path) -> Iterator[dict[str, Any]]:
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines(keepends=True):
            if line.endswith("\n"):
                yield json.loads(line, parse_constant=_refuse)


def trips(folder: Path) -> dict[str, dict[str, Any]]:
    """Return a run's trips by vehicle."""
    return {row["vehicle"]: row for row in pq.read_table(folder / "trips.parquet").to_pylist()}


def final_lanes(folder: Path) -> dict[str, int]:
    """Return on which lane each vehicle left."""
    return {vehicle: trip["final_lane"] for vehicle, trip in trips(folder).items()}


def mean_travel_time_s(folder: Path) -> float:
    """Return the mean travel time of all vehicles, counted or not."""
    return statistics.fmean(trip["travel_time_s"] for trip in trips(folder).values())


def check_safe_and_complete(folder: Path) -> None:
    """Check the promises that hold whatever happens to processes: all left, none overlapped."""
    found = summary(folder)
    vehicles = found["vehicles"]
    assert found["safety"]["overlaps"] == 0
    assert found["safety"]["sumo_collisions"] == 0
    assert vehicles["left"] == vehicles["entered"] == vehicles["demanded"] > 0
