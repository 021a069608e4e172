"""Drives corridors of SUMO simulations: `python benchmarks/corridors.py FILE [FILE ...]`.

Everything that `laneweave corridor FILE` lists is driven for `--duration` seconds of demand, in
virtual time, and then by SUMO alone. Prints one line for each corridor: the figures of the run, or
why laneweave does not drive it. Each file may be followed by corridors, and only these are driven.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from laneweave.launch.cli.corridor_command import corridor_tables
from laneweave.launch.report.corridor_comparison import compare
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.sim_bridge.corridors.corridor_search import find_approaches, find_corridors
from laneweave.sim_bridge.corridors.sumo_corridor import read_corridor
from laneweave.sim_bridge.corridors.sumo_simulation import TimeWindow, read_simulation


def driven(file: Path, name: str, window: TimeWindow) -> str:
    """Return the figures of a corridor, driven by laneweave and by SUMO alone."""
    found = read_corridor(file, name, window)
    scenario = parse_scenario(corridor_tables(found, file, window))
    with temporary_folder("corridor") as folder:
        summary = SimulatedRun(scenario, folder, show_progress=False).run().summary
        if summary is None:
            return "nobody has entered"
        trips = "; ".join(
            f"{one.entrance} to {one.destination} "
            + ", ".join(
                f"{count} of {one.vehicles} in {'-' if mean_s is None else f'{mean_s:.1f}'} s"
                for count, mean_s in zip(one.arrived, one.mean_s, strict=True)
            )
            for one in compare(scenario, folder)
        )
    vehicles, safety = summary.vehicles, summary.safety
    return (
        f"{found.corridor.length_m:.0f} m, {found.corridor.lanes} lanes; "
        f"{safety.overlaps} overlaps, {safety.sumo_collisions} collisions, "
        f"{vehicles.missed_exits} missed exits, {vehicles.on_preferred_lane} of {vehicles.left} in "
        f"a right lane, {vehicles.stopped_at_lane_end} stopped at the end "
        f"of a lane, {safety.hard_brakes} braked hard, lowest {safety.min_accel_mps2} m/s2, left "
        f"out {dict(vehicles.left_out or {})}; laneweave and SUMO alone: {trips}"
    )


def lines(file: Path, names: Sequence[str], window: TimeWindow) -> Iterator[str]:
    """Yield a line for each corridor of a simulation, or why it cannot be read."""
    try:
        simulation = read_simulation(file, window)
        found = [one.name for one in find_corridors(simulation)]
        found += [one.name for one in find_approaches(simulation)]
    except (BadInputError, CommandFailedError) as error:
        yield f"refused: {error}"
        return
    yield f"{len(simulation.network.edges)} edges, {len({*found})} chains of edges"
    for name in names or dict.fromkeys(found):
        try:
            yield f"{name}: {driven(file, name, window)}"
        except (BadInputError, CommandFailedError) as error:
            yield f"{name}: refused: {error}"


def main() -> int:
    """Drive the corridors of all simulations."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="+", help="configurations, each with corridors or without")
    parser.add_argument("--begin", type=float, help="SUMO's time of the first departure [s]")
    parser.add_argument("--duration", type=float, default=120.0, help="of the demand [s]")
    options = parser.parse_args()
    window = TimeWindow(begin_s=options.begin, duration_s=options.duration)
    simulations: list[tuple[Path, list[str]]] = []
    for name in options.names:
        if Path(name).is_file() or not simulations:
            simulations.append((Path(name), []))
        else:
            simulations[-1][1].append(name)
    for file, names in simulations:
        for line in lines(file, names, window):
            sys.stdout.write(f"{file.parent.name}/{file.name}: {line}\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
