"""Measure the speed of the PettingZoo environment: episodes of 85 vehicles in one process.

    python benchmarks/environment.py [--episodes 10] [--policy random|hold]

Prints road time by CPU time for each episode and for all, and the number of overlaps.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator, default_rng

from laneweave.env import VehiclesEnv, parallel_env
from laneweave.launch.run.roles import tune_garbage_collector
from laneweave.protocol.config.scenario_files import load_scenario

SCENARIO = Path(__file__).parents[1] / "scenarios" / "demo.toml"
DURATION_S = 78.0
"""Time during which vehicles arrive: 85 vehicles on average."""


def main() -> None:
    """Run episodes with varying demand and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--policy", choices=("random", "hold"), default="random")
    options = parser.parse_args()
    scenario = load_scenario(SCENARIO, demand__duration_s=DURATION_S)
    env, rng = parallel_env(scenario, vary_demand=True), default_rng(1)
    tune_garbage_collector()
    road_s = cpu_s = 0.0
    overlaps = vehicles = 0
    for seed in range(options.episodes):
        began_s = time.process_time()
        _, infos = env.reset(seed=seed)
        while env.agents:
            *_, infos = env.step(_choose(env, infos, rng, hold=options.policy == "hold"))
        took_s = time.process_time() - began_s
        road_s, cpu_s = road_s + env.t_s, cpu_s + took_s
        overlaps += len(env.record.overlaps)
        vehicles += len(env.record.trips)
        say(f"{len(env.record.trips)} vehicles, {env.t_s:.1f} s: {env.t_s / took_s:.1f} x")
    say(f"{vehicles} vehicles in all: {road_s / cpu_s:.1f} x real time, {overlaps} overlaps")


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _choose(
    env: VehiclesEnv, infos: Mapping[str, Mapping[str, Any]], rng: Generator, *, hold: bool
) -> dict[str, int]:
    if hold:
        return {}
    return {
        name: int(rng.choice(np.flatnonzero(infos[name]["action_mask"]))) for name in env.agents
    }


if __name__ == "__main__":
    main()
