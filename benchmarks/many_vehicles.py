"""Measure a road of 10 km with 1,000 vehicles, run by a few processes over Zenoh.

    python benchmarks/many_vehicles.py [--vehicles-per-process N] [--operation NAME]

1800 vehicles/(lane h) arrive for 740 s of road time, until the first ones have reached the end of
the road. Prints the real-time factor of the run and for each number of vehicles on the road, the
memory of all processes, and the minimum gap and acceleration. A run takes about ten minutes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

import psutil
import pyarrow.parquet as pq

import laneweave

SEED = 77
LENGTH_M, VOLUME, DURATION_S = 9600.0, 1800.0, 740.0
"""Length of the section in which vehicles drive on [m], demand [veh/(lane h)], duration [s]."""
CLASS = 100
"""Vehicles on the road are counted in classes of this size."""
SAMPLE_S = 5.0


class Memory(threading.Thread):
    """Samples the memory of this process and its children that no other process shares."""

    def __init__(self) -> None:
        """Start sampling."""
        super().__init__(daemon=True)
        self.peak_bytes = 0
        self._ended = threading.Event()
        self.start()

    def run(self) -> None:
        """Take samples until `end` is called."""
        own = psutil.Process()
        while not self._ended.wait(SAMPLE_S):
            total = 0
            for process in (own, *own.children(recursive=True)):
                try:
                    total += process.memory_full_info().pss
                except psutil.NoSuchProcess:
                    continue
            self.peak_bytes = max(self.peak_bytes, total)

    def end(self) -> float:
        """Stop sampling; return the highest total [GiB]."""
        self._ended.set()
        self.join()
        return self.peak_bytes / 2**30


def drive(folder: Path, operation: str, per_process: int) -> laneweave.RunSummary:
    """Run the road; it ends before all vehicles have left it."""
    try:
        return laneweave.run(
            out=folder,
            seed=SEED,
            road__s3_m=LENGTH_M,
            demand__volume_veh_per_lane_h=VOLUME,
            demand__duration_s=DURATION_S,
            formation__operation=operation,
            runtime__max_road_s=DURATION_S,
            runtime__max_pace=20.0,
            runtime__vehicles_per_process=per_process,
        )
    except laneweave.RunFailedError as error:
        if error.summary is None:
            raise
        return error.summary


def factors(ticks: Path) -> list[tuple[int, float]]:
    """Return the real-time factor by number of vehicles on the road, in classes."""
    table = pq.read_table(ticks, columns=["on_road", "tick_ms"]).to_pydict()
    spent_ms: dict[int, list[float]] = {}
    for on_road, tick_ms in zip(table["on_road"], table["tick_ms"], strict=True):
        spent_ms.setdefault(on_road // CLASS, []).append(tick_ms)
    tick_ms = 1e3 * laneweave.load_scenario().runtime.tick_s
    return [
        (CLASS * number, tick_ms * len(spent) / sum(spent))
        for number, spent in sorted(spent_ms.items())
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the road and print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--vehicles-per-process", type=int, default=250, metavar="N")
    parser.add_argument("--operation", default="formations")
    options = parser.parse_args(arguments)
    memory = Memory()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        summary = drive(out, options.operation, options.vehicles_per_process)
        peak_gib = memory.end()
        found = summary.to_json()
        runtime, vehicles, safety = found["runtime"], found["vehicles"], found["safety"]
        lines = [
            f"{options.operation}, {options.vehicles_per_process} vehicles per process:",
            f"{runtime['real_time_factor']:6.2f} times real time",
            *(
                f"{factor:6.2f} times real time with {number} to {number + CLASS - 1} vehicles"
                for number, factor in factors(out / "ticks.parquet")
            ),
            f"{vehicles['peak']:6d} vehicles at most",
            f"{peak_gib:6.2f} GiB at most",
            f"{safety['min_gap_m']:6.2f} m minimum gap",
            f"{safety['min_accel_mps2']:6.2f} m/s2 minimum acceleration",
            f"{found['planning']['fallbacks']:6d} fallbacks",
        ]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
