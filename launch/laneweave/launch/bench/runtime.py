"""`laneweave bench runtime`: CPU time and memory of the processes of a run.

Reports medians, and rates within one run, because other load on the machine varies.
"""

from __future__ import annotations

import contextlib
import os
import platform
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import psutil
import pyarrow.parquet as pq
from attrs import define, field
from rich.table import Table

from laneweave.launch.faults.fault_file import load_faults
from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.recordings.files import TICKS_FILE
from laneweave.launch.run.local_run import LocalRun
from laneweave.protocol.config.participants import coordinator_names
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.recording.statistics import percentiles_of

ROLES = ("router", "coordinator", "bridge", "agent")
CPU_PERIOD_S = 0.3
WARM_UP_S = 10.0
"""Road time from when the road is full to the first measurement."""


@define
class _Window:
    """CPU time and memory of all processes during the measured part of a run."""

    begin_s: float
    end_s: float
    seen: dict[str, tuple[psutil.Process, float]] = field(factory=dict)
    """Each process and its CPU time at the last measurement."""
    measured_s: float = 0.0
    began: tuple[float, float] | None = None
    ended: tuple[float, float] | None = None
    """(road time, wall-clock time) at the end, as `began` at the beginning."""
    cpu_s: dict[str, float] = field(factory=dict)
    """CPU time by role."""
    memory: dict[str, list[tuple[float, float]]] = field(factory=dict)
    """(PSS, USS) [MiB] of each process, by role."""

    def watch(self, view: RoadView, process_ids: Mapping[str, int]) -> None:
        """Take measurements while the window is open."""
        now_s = time.perf_counter()
        if self.began is None and view.t_s >= self.begin_s:
            self.began = (view.t_s, now_s)
            self._measure_cpu(process_ids, count=False)
        elif self.began is not None and self.ended is None:
            if view.t_s >= self.end_s:
                self.ended = (view.t_s, now_s)
                self._measure_cpu(process_ids, count=True)
                self._measure_memory(process_ids)
            elif now_s >= self.measured_s + CPU_PERIOD_S:
                # Measure often: the CPU time of a process is unknown once it has exited.
                self.measured_s = now_s
                self._measure_cpu(process_ids, count=True)

    def _measure_cpu(self, process_ids: Mapping[str, int], *, count: bool) -> None:
        for name, process_id in process_ids.items():
            with contextlib.suppress(psutil.Error):
                process, before = self.seen.get(name) or (psutil.Process(process_id), 0.0)
                cpu_s = _cpu_s(process)
                self.seen[name] = (process, cpu_s)
                if count:
                    role = _role(name)
                    self.cpu_s[role] = self.cpu_s.get(role, 0.0) + cpu_s - before

    def _measure_memory(self, process_ids: Mapping[str, int]) -> None:
        for name, process_id in process_ids.items():
            with contextlib.suppress(psutil.Error):
                info = psutil.Process(process_id).memory_full_info()
                self.memory.setdefault(_role(name), []).append((info.pss / 2**20, info.uss / 2**20))


def bench_runtime(
    vehicles: int, *, seconds: float, per_process: int, seed: int, faults: str | None = None
) -> dict[str, Any]:
    """Measure a run with about `vehicles` vehicles on the road, `per_process` in each process.

    Args:
        vehicles: mean number of vehicles on the road, which determines the volume.
        seconds: measured road time [s].
        per_process: agents in each process.
        seed: seed of the arrivals.
        faults: a fault file or a preset; None: no faults.

    Returns:
        Real-time factor, tick time, CPU and memory per role, over `seconds` of road time.

    Raises:
        BadInputError: the fault file or preset does not exist, or is invalid.
        CommandFailedError: the run has failed, or ended within the measured time.
    """
    base = load_scenario(None)
    volume = vehicles / (base.geometry.free_flow_s * base.road.lanes) * 3600.0
    begin_s = base.geometry.free_flow_s + WARM_UP_S
    scenario = load_scenario(
        None,
        seed=seed,
        demand__volume_veh_per_lane_h=volume,
        demand__duration_s=begin_s + seconds,
        runtime__vehicles_per_process=per_process,
    )
    window = _Window(begin_s, begin_s + seconds)
    with temporary_folder("bench") as folder:
        run = LocalRun(
            scenario,
            folder / "run",
            load_faults(faults, coordinator_names(scenario)),
            show_progress=False,
            watch=window.watch,
        )
        outcome = run.run().or_interrupt()
        if window.ended is None or outcome.problems:
            why = "; ".join(outcome.problems) or "it ended before the end of the measurement"
            raise CommandFailedError(f"the run with {vehicles} vehicles has failed: {why}")
        ticks = pq.read_table(folder / "run" / TICKS_FILE)
    times_s = ticks.column("t_s").to_numpy()
    measured = (times_s > window.begin_s) & (times_s <= window.end_s)
    return {
        "vehicles_wanted": vehicles,
        "volume_veh_per_lane_h": round(volume, 1),
        "vehicles_per_process": per_process,
        "faults": faults,
        "vehicles_on_road": round(float(ticks.column("on_road").to_numpy()[measured].mean()), 1),
        "real_time_factor": _real_time_factor(window),
        "tick_ms": percentiles_of(ticks.column("tick_ms").to_numpy()[measured], 50, 99),
        "cpu_ms_per_tick": _per_tick(window, scenario),
        "memory_mib": _memory(window),
    }


def machine() -> dict[str, Any]:
    """Return the properties of this machine that affect the results."""
    return {
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "platform": platform.platform(),
    }


def runtime_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the results of `bench_runtime` as a table."""
    table = Table("vehicles", "per process", "faults", "real-time factor", "tick ms p50", "p99")
    for role in ROLES:
        table.add_column(f"{role} CPU ms/tick")
    table.add_column("agents' memory MiB")
    table.add_column("each")
    for row in rows:
        cpu, memory = row["cpu_ms_per_tick"], row["memory_mib"].get("agent", {})
        table.add_row(
            f"{row['vehicles_on_road']:.0f}",
            str(row["vehicles_per_process"]),
            row["faults"] or "none",
            f"{row['real_time_factor']:.2f}",
            *(f"{row['tick_ms'][name]:.1f}" for name in ("p50", "p99")),
            *(f"{cpu.get(role, 0.0):.2f}" for role in ROLES),
            f"{memory.get('total', 0.0):.0f}",
            f"{memory.get('each', 0.0):.1f}",
        )
    return table


def _role(name: str) -> str:
    return "coordinator" if name.startswith("c") else name.partition("-")[0]


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _real_time_factor(window: _Window) -> float:
    if window.began is None or window.ended is None:
        return 0.0
    road_s, wall_s = (end - begin for begin, end in zip(window.began, window.ended, strict=True))
    return round(road_s / wall_s, 3)


def _per_tick(window: _Window, scenario: Scenario) -> dict[str, float]:
    ticks = (window.end_s - window.begin_s) / scenario.runtime.tick_s
    return {role: round(cpu * 1e3 / ticks, 3) for role, cpu in sorted(window.cpu_s.items())}


def _memory(window: _Window) -> dict[str, dict[str, float]]:
    return {
        role: {
            "processes": len(pairs),
            "total": round(sum(pss for pss, _ in pairs), 1),
            "each": round(float(np.median([pss for pss, _ in pairs])), 2),
            "own_each": round(float(np.median([uss for _, uss in pairs])), 2),
        }
        for role, pairs in sorted(window.memory.items())
    }
