"""Interchanges in light and dense traffic: nobody misses an exit, nobody brakes hard."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from laneweave.launch.cli.corridor_command import corridor_tables
from laneweave.launch.recordings.trajectories import read_trajectories
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.sim_bridge.corridors.sumo_corridor import read_corridor
from laneweave.sim_bridge.corridors.sumo_simulation import WHOLE
from support import corridor_oracle
from support.interchange import (
    CORRIDOR,
    EXIT_FIRST,
    RAMP_FIRST,
    TRUCKS,
    vehicle,
    write_interchange,
)

DEMAND_S = 60.0
HARDEST_MPS2 = -4.0
RAMP_VEH_PER_H = 360.0
TRUCK_SHARE, EXIT_SHARE = 0.25, 0.15
IN_CI = (3700, 1)
"""Volume [veh/h] and seed of the runs that CI makes."""
NETWORKS = {
    "exit-first": (EXIT_FIRST, {"main": "main", "exit": "exit", "ramp": "ramp"}),
    "ramp-first": (RAMP_FIRST, {"main": "main", "exit": "late exit", "ramp": "early ramp"}),
}


def traffic(volume_veh_per_h: float, seed: int) -> Iterator[tuple[float, str, str]]:
    """Yield departure, kind of way and type of the vehicles of a minute."""
    rng = Random(1000 * seed + volume_veh_per_h)
    for way, volume in (("main", volume_veh_per_h), ("ramp", RAMP_VEH_PER_H)):
        mean_s = 3600.0 / volume
        t_s = rng.uniform(0.0, mean_s)
        while t_s < DEMAND_S:
            leaves = way == "main" and rng.random() < EXIT_SHARE
            yield t_s, "exit" if leaves else way, "truck" if rng.random() < TRUCK_SHARE else "car"
            t_s += rng.uniform(0.4, 1.6) * mean_s


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize(
    ("volume", "seed"),
    [
        pytest.param(
            volume, seed, marks=pytest.mark.more if (volume, seed) == IN_CI else pytest.mark.full
        )
        for volume in (1800, 3700)
        for seed in range(1, 11)
    ],
)
def test_all_leave_by_their_exits(tmp_path: Path, network: str, volume: int, seed: int) -> None:
    road, ways = NETWORKS[network]
    vehicles = [
        vehicle(f"{way}{number}", round(t_s, 2), ways[way], kind)
        for number, (t_s, way, kind) in enumerate(sorted(traffic(volume, seed)))
    ]
    config = write_interchange(tmp_path, vehicles, types=TRUCKS, network=road)
    tables = corridor_tables(read_corridor(config, CORRIDOR), config, WHOLE)
    run = tmp_path / "run"
    outcome = SimulatedRun(parse_scenario(tables), run, show_progress=False).run()
    routes = config.with_name("small.rou.xml")
    sizes = {"car": (5.0, 1.8), "truck": (7.1, 2.4)}
    wrong = corridor_oracle.problems(run, CORRIDOR, routes, sizes)
    assert (*outcome.problems, *wrong) == ()
    assert outcome.summary is not None
    assert outcome.summary.vehicles.missed_exits == 0
    accels = read_trajectories(run, ["accel_mps2"]).to_pydict()["accel_mps2"]
    assert min(map(float, accels)) >= HARDEST_MPS2
