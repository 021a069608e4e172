"""Measure the memory of long runs: `python benchmarks/long_run.py [--zenoh] [--json FILE]`.

By default, one run in virtual time with all roles in this process. With `--zenoh`, a deployment on
this machine in real time: router, two coordinators, two agent processes and the bridge. Every role
is sampled from its start to its end:

    memory_mb    memory of the process that no file backs
    handles      open file descriptors
    threads      threads

The growth of a role is measured between the first ten minutes and the end of the run: from the
median of the samples in minutes 10 to 15 to the median of those in the last five minutes.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import platform
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil
from attrs import define, evolve, field, frozen

from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import read_summary
from laneweave.protocol.wire.messages import RoadClock

LANEWEAVE = str(Path(sys.executable).with_name("laneweave"))
SETTLED_S = 600.0
"""Time after which memory must not grow."""
WINDOW_S = 300.0
"""Length of the two periods that are compared."""
SAMPLE_S = 10.0
"""Interval between samples: road time in virtual time, else wall-clock time."""
START_S = 15.0
STOP_S = 30.0
DEPLOYMENT = """\
schema = "laneweave.scenario/1"
seed = 1
[demand]
volume_veh_per_lane_h = {volume}
duration_s = {duration_s}
[formation]
operation = "{operation}"
[network]
realm = "long"
endpoint = "unixsock-stream/router.sock"
connect_timeout_s = 60.0
[runtime]
coordinators = 2
"""
ROLES = {
    "router": ("router",),
    "coordinator c1": ("coordinator", "--name", "c1"),
    "coordinator c2": ("coordinator", "--name", "c2"),
    "agents 1": ("agent", "--shard", "0/2"),
    "agents 2": ("agent", "--shard", "1/2"),
    "bridge": ("bridge", "--out", "run", "--pace", "1"),
}


@frozen
class Sample:
    """Resources of one process at one time."""

    t_s: float
    memory_mb: float
    handles: int
    threads: int

    @classmethod
    def of(cls, process: psutil.Process, t_s: float) -> Sample:
        """Measure a process."""
        memory = process.memory_info()
        return cls(
            t_s, (memory.rss - memory.shared) / 1e6, process.num_fds(), process.num_threads()
        )


@define
class Samples:
    """Samples of one role."""

    all: list[Sample] = field(factory=list)

    def summary(self) -> dict[str, Any]:
        """Return both medians, the growth between them, and all samples, one a minute."""
        last_s = self.all[-1].t_s
        early = self._between(SETTLED_S, SETTLED_S + WINDOW_S) or self.all[:1]
        late = self._between(last_s - WINDOW_S, last_s)
        before_mb, after_mb = (
            statistics.median(one.memory_mb for one in samples) for samples in (early, late)
        )
        per_minute = round(60.0 / SAMPLE_S)
        return {
            "memory_mb": [round(before_mb, 1), round(after_mb, 1)],
            "growth_percent": round(100.0 * (after_mb / before_mb - 1.0), 1),
            "handles": [_median(samples, "handles") for samples in (early, late)],
            "threads": [_median(samples, "threads") for samples in (early, late)],
            "minutes_mb": [round(one.memory_mb, 1) for one in self.all[::per_minute]],
        }

    def _between(self, from_s: float, until_s: float) -> list[Sample]:
        return [one for one in self.all if from_s <= one.t_s <= until_s]


def _median(samples: Sequence[Sample], name: str) -> float:
    return float(statistics.median(getattr(one, name) for one in samples))


@define
class VirtualRun:
    """A run in virtual time, sampled in its own process."""

    scenario: Scenario
    samples: Samples = field(factory=Samples)
    clock: RoadClock | None = None
    vehicle_ticks: float = 0.0

    def run(self, folder: Path) -> dict[str, Any]:
        """Drive the scenario and return the figures."""
        began_s = time.process_time()
        SimulatedRun(
            self.scenario, folder, show_progress=False, watch=self._watch
        ).run().or_interrupt()
        clock = self.clock
        assert clock is not None  # noqa: S101 (the run has had ticks)
        return {
            "road_s": round(clock.t_s),
            "left": clock.left,
            "vehicle_ticks": round(self.vehicle_ticks),
            "cpu_s": round(time.process_time() - began_s),
            "roles": {"all": self.samples.summary()},
        }

    def _watch(self, view: RoadView) -> None:
        clock, before = view.clock, self.clock
        if clock is None:
            return
        self.clock = clock
        if before is not None:
            self.vehicle_ticks += (clock.tick - before.tick) * (clock.on_road + before.on_road) / 2
        arriving = clock.t_s <= self.scenario.demand.duration_s
        if arriving and clock.t_s >= SAMPLE_S * len(self.samples.all):
            gc.collect()
            self.samples.all.append(Sample.of(psutil.Process(), clock.t_s))


@define
class Deployment:
    """The processes of a deployment in a folder."""

    folder: Path
    processes: dict[str, subprocess.Popen[bytes]] = field(factory=dict)

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Start all roles, the bridge last, and stop them at the end."""
        try:
            for role, arguments in ROLES.items():
                if role == "bridge":
                    time.sleep(START_S)  # until a coordinator can plan
                self.processes[role] = subprocess.Popen(  # noqa: S603
                    [LANEWEAVE, *arguments, "--config", "deployment.toml"], cwd=self.folder
                )
            yield
        finally:
            for process in reversed(self.processes.values()):
                process.send_signal(signal.SIGTERM)
                process.wait(STOP_S)

    def sample(self, duration_s: float) -> dict[str, Samples]:
        """Sample all roles until vehicles no longer arrive."""
        measured = {role: psutil.Process(one.pid) for role, one in self.processes.items()}
        samples = {role: Samples() for role in measured}
        began_s = time.monotonic()
        while (t_s := time.monotonic() - began_s) < duration_s:
            if self.processes["bridge"].poll() is not None:
                raise RuntimeError("the bridge ended before the vehicles stopped arriving")
            for role, process in measured.items():
                samples[role].all.append(Sample.of(process, t_s))
            time.sleep(max(0.0, SAMPLE_S - (time.monotonic() - began_s - t_s)))
        return samples


def run_deployment(scenario: Scenario, folder: Path) -> dict[str, Any]:
    """Run the scenario over Zenoh in real time, and return the figures of each role."""
    text = DEPLOYMENT.format(
        volume=scenario.demand.volume_veh_per_lane_h,
        duration_s=scenario.demand.duration_s,
        operation=scenario.formation.operation,
    )
    (folder / "deployment.toml").write_text(text, encoding="utf-8")
    deployment = Deployment(folder)
    with deployment.running():
        samples = deployment.sample(scenario.demand.duration_s)
    summary = read_summary(folder / "run")
    assert summary is not None  # noqa: S101 (the bridge has ended)
    road_s, lanes = summary.simulated_s, scenario.road.lanes
    on_road = scenario.geometry.free_flow_s * scenario.demand.volume_veh_per_lane_h * lanes / 3600.0
    return {
        "road_s": round(road_s),
        "left": summary.vehicles.left,
        "vehicle_ticks": round(on_road * road_s / scenario.runtime.tick_s),
        "left_over_processes": sum(one.poll() is None for one in deployment.processes.values()),
        "roles": {role: each.summary() for role, each in samples.items()},
    }


def main() -> None:
    """Run the measurement, print the figures, and add them to a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--zenoh", action="store_true", help="a deployment in real time")
    parser.add_argument("--operation", default="formations")
    parser.add_argument("--volume", type=float, default=1600.0, help="vehicles/(lane h)")
    parser.add_argument("--duration", type=float, default=3600.0, help="arrivals [s]")
    parser.add_argument("--json", type=Path, help="file to add the figures to")
    chosen = parser.parse_args()
    scenario = Scenario()
    scenario = evolve(
        scenario,
        seed=1,
        demand=evolve(
            scenario.demand, volume_veh_per_lane_h=chosen.volume, duration_s=chosen.duration
        ),
        formation=evolve(scenario.formation, operation=chosen.operation),
    )
    folder = Path(tempfile.mkdtemp(prefix="laneweave-long-"))
    try:
        figures = (
            run_deployment(scenario, folder) if chosen.zenoh else VirtualRun(scenario).run(folder)
        )
    finally:
        shutil.rmtree(folder)
    figures |= {"volume_veh_per_lane_h": chosen.volume, "python": platform.python_version()}
    print(json.dumps(figures))  # noqa: T201
    if chosen.json is not None:
        known = json.loads(chosen.json.read_text("utf-8")) if chosen.json.exists() else {}
        known[f"{'zenoh' if chosen.zenoh else 'virtual'}, {chosen.operation}"] = figures
        chosen.json.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
