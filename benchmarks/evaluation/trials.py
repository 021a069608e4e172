"""Single runs in addition to the sweep, each a separate `laneweave run`.

zenoh     points of the sweep over Zenoh, one process per vehicle, and the same points simulated
speed     the same demand in three deployments, for real-time factors
length    a short and a long road, for the cost of a vehicle
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pyarrow.compute as pc
import pyarrow.parquet as pq
from attrs import frozen

from laneweave.launch.recordings.files import TICKS_FILE
from laneweave.launch.recordings.runs import scenario_of
from laneweave.launch.sweep.execution import StoppedError, wait_for_exit
from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.summary import Ending, RunSummary, read_summary

ZENOH_VOLUMES: Final = (1000, 1600, 2000)
"""Volumes that are repeated over Zenoh, in vehicles/(lane h)."""
TIMEOUT_S: Final = 3600.0
"""Maximum duration of a run."""
COMMAND_FILE: Final = "command.json"
_ROUNDING_S = 1e-6


@frozen
class Agreement:
    """Comparison of two runs of the same demand."""

    vehicles: int
    """Number that left the road in both runs."""
    missing: int
    """Number that left the road in one run only."""
    other_lane: int
    """Number whose final lanes differ between the runs."""
    over_a_tick: int
    """Number whose travel times differ by more than a tick."""
    worst_s: float
    """Maximum difference of travel times."""

    @property
    def holds(self) -> bool:
        """Whether there are vehicles, and all have the same lane and travel time within a tick."""
        return bool(self.vehicles) and not (self.missing or self.other_lane or self.over_a_tick)


def read_trips(folder: Path) -> list[dict[str, Any]]:
    """Return the compared columns of a run's trips.

    Raises:
        OSError, ValueError: the trips cannot be read.
    """
    columns = ["vehicle", "final_lane", "travel_time_s"]
    return pq.read_table(folder / "trips.parquet", columns=columns).to_pylist()


def agreement(
    one: Sequence[Mapping[str, Any]], other: Sequence[Mapping[str, Any]], tick_s: float
) -> Agreement:
    """Compare two runs of the same demand.

    Args:
        one: trips of one run.
        other: trips of the other run.
        tick_s: permitted difference of travel times.
    """
    first, second = ({trip["vehicle"]: trip for trip in trips} for trips in (one, other))
    left = [
        {name for name, trip in trips.items() if trip["travel_time_s"] is not None}
        for trips in (first, second)
    ]
    both = sorted(left[0] & left[1])
    apart_s = [abs(first[name]["travel_time_s"] - second[name]["travel_time_s"]) for name in both]
    return Agreement(
        vehicles=len(both),
        missing=len((left[0] ^ left[1]) | (first.keys() ^ second.keys())),
        other_lane=sum(first[name]["final_lane"] != second[name]["final_lane"] for name in both),
        over_a_tick=sum(apart > tick_s + _ROUNDING_S for apart in apart_s),
        worst_s=round(max(apart_s, default=0.0), 3),
    )


@frozen
class Trial:
    """A single run."""

    part: str
    name: str
    options: tuple[str, ...]
    """Options of `laneweave run`."""
    ending: str = "complete"
    """Expected ending in summary.json; a run with another ending, or with overlaps, has failed."""
    is_shared: bool = False
    """Whether other trials may run at the same time; the trial's times are not evaluated."""

    @property
    def status(self) -> int:
        """Expected exit status of the command."""
        return 0 if self.ending == Ending.COMPLETE.value else 1

    @property
    def command(self) -> str:
        """The command line without the output folder."""
        return shlex.join(("laneweave", "run", *self.options))


@frozen
class AgreementRow:
    """A point over Zenoh compared with the same point simulated."""

    volume_veh_per_lane_h: float
    seed: int
    duration_s: float
    overlaps: int
    """In the run over Zenoh."""
    processes: int | None
    agreement: Agreement


@frozen
class FactorRow:
    """Execution speed of a deployment."""

    trial: str
    command: str
    processes: int | None
    vehicles_peak: int
    real_time_factor: float
    """Over the whole run, including the time in which the road fills and empties."""
    tick_p50_ms: float | None
    tick_p99_ms: float | None


@frozen
class CostRow:
    """Computing time of a vehicle on a road."""

    trial: str
    command: str
    road_m: float
    vehicles_peak: int
    cost_ms: float
    """Wall-clock time of the run per vehicle and tick."""


def _demand(volume: int, duration_s: int, *more: str) -> tuple[str, ...]:
    return ("--volume", f"{volume}", "--seed", "1", "--duration", f"{duration_s}", *more)


SIMULATED: Final = ("--transport", "simulated")
TRIALS: Final = (
    *(
        trial
        for volume in ZENOH_VOLUMES
        for trial in (
            Trial("zenoh", f"zenoh-{volume}", _demand(volume, 120)),
            Trial("zenoh", f"simulated-{volume}", _demand(volume, 120, *SIMULATED), is_shared=True),
        )
    ),
    Trial("speed", "zenoh", _demand(1600, 300)),
    Trial("speed", "zenoh-50", _demand(1600, 300, "--vehicles-per-process", "50")),
    Trial("speed", "simulated", _demand(1600, 300, *SIMULATED)),
    # Stops after the road has been full for a while; the time until it is empty is not needed.
    Trial("length", "long", ("benchmarks/long-road.toml", *SIMULATED), ending="limit"),
    Trial("length", "short", _demand(1800, 600, "--operation", "rolling", *SIMULATED)),
)


def run_trial(trial: Trial, out: Path, root: Path, stopped: Callable[[], bool]) -> None:
    """Run a trial unless it has been run with the same options.

    Args:
        trial: the run.
        out: the evaluation's folder.
        root: folder that scenario files are relative to.
        stopped: returns whether the evaluation was stopped.

    Raises:
        CommandFailedError: the run failed, violated a guarantee, or timed out.
        StoppedError: the evaluation was stopped, and the run with it.
    """
    folder = out.resolve() / trial.part / trial.name
    if is_finished(trial, out):
        return
    if folder.exists():
        shutil.rmtree(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    program = str(Path(sys.executable).with_name("laneweave"))
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(  # noqa: S603 - this package, with options of its own
            [program, "run", *trial.options, "--no-progress", "--out", str(folder)],
            cwd=root,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            process_group=0,
        )
        end_s = time.monotonic() + TIMEOUT_S
        try:
            wait_for_exit(process, trial.name, lambda: stopped() or time.monotonic() > end_s)
        except StoppedError as error:
            if stopped():
                raise
            late = f"{trial.command}: not finished after {TIMEOUT_S:g} s"
            raise CommandFailedError(late) from error
        output.seek(0)
        message = " ".join(output.read().decode(errors="replace").split())
    if process.returncode != trial.status or not _ended_as_expected(trial, folder):
        raise CommandFailedError(f"{trial.command}: status {process.returncode}: {message[-400:]}")
    (folder / COMMAND_FILE).write_text(json.dumps(trial.options), encoding="utf-8")


def _ended_as_expected(trial: Trial, folder: Path) -> bool:
    summary = read_summary(folder)
    return summary is not None and summary.ending == trial.ending and not summary.safety.overlaps


def is_finished(trial: Trial, out: Path) -> bool:
    """Return whether a trial has been run with the same options."""
    path = out / trial.part / trial.name / COMMAND_FILE
    try:
        return tuple(json.loads(path.read_text(encoding="utf-8"))) == trial.options
    except (OSError, ValueError):
        return False


def agreement_rows(out: Path) -> list[AgreementRow]:
    """Return the comparisons of finished runs over Zenoh with simulated ones.

    Raises:
        OSError, ValueError, KeyError: a run's files cannot be read.
    """
    rows = []
    for volume in ZENOH_VOLUMES:
        names = (f"zenoh-{volume}", f"simulated-{volume}")
        if not all(is_finished(_trial("zenoh", name), out) for name in names):
            continue
        real, simulated = (out / "zenoh" / name for name in names)
        summary, scenario = _summary(real), scenario_of(real / "trips.parquet")
        tick_s = scenario.runtime.tick_s
        rows.append(
            AgreementRow(
                volume_veh_per_lane_h=float(volume),
                seed=summary.seed,
                duration_s=scenario.demand.duration_s,
                overlaps=summary.safety.overlaps,
                processes=summary.runtime.processes,
                agreement=agreement(read_trips(real), read_trips(simulated), tick_s),
            )
        )
    return rows


def factor_rows(out: Path) -> list[FactorRow]:
    """Return the execution speeds of the finished deployments.

    Raises:
        OSError, ValueError, KeyError: a run's files cannot be read.
    """
    rows = []
    for trial in _finished("speed", out):
        summary = _summary(out / trial.part / trial.name)
        runtime = summary.runtime
        rows.append(
            FactorRow(
                trial=trial.name,
                command=trial.command,
                processes=runtime.processes,
                vehicles_peak=summary.vehicles.peak,
                real_time_factor=runtime.real_time_factor,
                tick_p50_ms=runtime.tick_ms.p50,
                tick_p99_ms=runtime.tick_ms.p99,
            )
        )
    return rows


def cost_rows(out: Path) -> list[CostRow]:
    """Return the cost of a vehicle on each finished road.

    Raises:
        OSError, ValueError, KeyError: a run's files cannot be read.
    """
    rows = []
    for trial in _finished("length", out):
        folder = out / trial.part / trial.name
        summary = _summary(folder)
        ticks = pq.read_table(folder / TICKS_FILE, columns=["on_road"])
        driven = pc.sum(ticks["on_road"]).as_py() or 0
        rows.append(
            CostRow(
                trial=trial.name,
                command=trial.command,
                road_m=summary.road_m,
                vehicles_peak=summary.vehicles.peak,
                cost_ms=round(1e3 * summary.runtime.wall_s / max(1, driven), 4),
            )
        )
    return rows


def _finished(part: str, out: Path) -> list[Trial]:
    return [trial for trial in TRIALS if trial.part == part and is_finished(trial, out)]


def _trial(part: str, name: str) -> Trial:
    return next(trial for trial in TRIALS if (trial.part, trial.name) == (part, name))


def _summary(folder: Path) -> RunSummary:
    summary = read_summary(folder)
    if summary is None:
        raise ValueError(f"{folder}: summary.json is missing or incomplete")
    return summary
