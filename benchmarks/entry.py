"""Entry and formation building without driving: `python benchmarks/entry.py`.

For each volume: the time from the arrival of a vehicle to the moment at which its cell
passes the start of the road (negative if the cell passes first), and the columns and
vehicles of formations. If this time grows with the duration, more vehicles arrive than can enter.
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

import numpy as np

from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import ClosedFormation
from laneweave.sim_bridge.road.demand import arrivals
from laneweave.sim_bridge.road.entry import Admission, EntryMeter
from laneweave.sim_bridge.road.formation_building import formation_builder

VOLUMES = (500, 1000, 1300, 1600, 1750, 1800, 2000, 2100, 2150, 2200, 2400)
NOT_COUNTED_S, STEP_S, MAX_WAIT_S = 60.0, 0.5, 2000.0
HEADINGS = ("veh/(lane h)", "wait s mean", "wait s p95", "columns", "vehicles")


def enter(scenario: Scenario) -> tuple[list[float], list[int], list[int]]:
    """Return the wait [s] of each vehicle, and the columns and vehicles of each formation."""
    builder, lattice = formation_builder(scenario), scenario.lattice
    formation = scenario.formation
    meter = EntryMeter(lattice, formation.entry_spread_s, builder, interlaced=formation.interlaced)
    demand = arrivals(scenario)
    for arrival in demand:
        meter.demand(arrival)
    entered: list[Admission] = []
    closed: list[ClosedFormation] = []
    t_s = 0.0
    while (len(entered) < len(demand) or not closed) and t_s < MAX_WAIT_S + demand[-1].t_s:
        t_s += STEP_S
        entered += meter.admit(t_s)
        closed += builder.closed(t_s)
    columns = [formation.columns(lattice) for formation in closed]
    counts = [sum(admission.cell[0] in own for admission in entered) for own in columns]
    waits_s = [
        lattice.passing_time_s(admission.cell[0]) - admission.arrival.t_s
        for admission in entered
        if admission.arrival.t_s >= NOT_COUNTED_S
    ]
    return waits_s, [len(own) for own in columns], counts


def measure(volume: float, seeds: int, duration_s: float, operation: str) -> dict[str, Any]:
    """Return means over all seeds at one volume [vehicles/(lane h)]; see `HEADINGS`."""
    waits_s: list[float] = []
    columns: list[int] = []
    vehicles: list[int] = []
    for seed in range(1, seeds + 1):
        scenario = load_scenario(
            None,
            seed=seed,
            demand__volume_veh_per_lane_h=float(volume),
            demand__duration_s=duration_s,
            formation__operation=operation,
        )
        new_waits_s, new_columns, new_vehicles = enter(scenario)
        waits_s += new_waits_s
        columns += new_columns
        vehicles += new_vehicles
    return {
        "volume_veh_per_lane_h": volume,
        "wait_s_mean": round(float(np.mean(waits_s)), 2),
        "wait_s_p95": round(float(np.percentile(waits_s, 95)), 2),
        "columns": round(float(np.mean(columns)), 2),
        "vehicles": round(float(np.mean(vehicles)), 2),
    }


def main() -> None:
    """Measure and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--volumes", type=int, nargs="+", default=VOLUMES, help="veh/(lane h)")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument(
        "--duration", type=float, default=600.0, help="duration of the arrivals [s]"
    )
    parser.add_argument("--operation", choices=("formations", "paper"), default="formations")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    rows = [
        measure(volume, chosen.seeds, chosen.duration, chosen.operation)
        for volume in chosen.volumes
    ]
    if chosen.json:
        json.dump(rows, sys.stdout, indent=2)
        return
    for line in (HEADINGS, *(row.values() for row in rows)):
        sys.stdout.write("".join(f"{cell:>14}" for cell in line) + "\n")


if __name__ == "__main__":
    main()
