"""Measure the speed of the PettingZoo environment: episodes of 85 vehicles in one process.

    python benchmarks/environment.py [--episodes 10] [--policy lane|random|hold]

`lane` moves towards the preferred lane; `random` makes any allowed move in each slot, so that half
of the vehicles move at any time. Prints road time by CPU time, and the number of overlaps.
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
from laneweave.env.observations import OWN, Observation
from laneweave.launch.run.roles import tune_garbage_collector
from laneweave.protocol.config.scenario_files import load_scenario

SCENARIO = Path(__file__).parents[1] / "scenarios" / "demo.toml"
TO_TARGET = OWN.index("to_target")
POLICIES = ("lane", "random", "hold")
DURATION_S = 78.0
"""Time during which vehicles arrive: 85 vehicles on average."""


def main() -> None:
    """Run episodes with varying demand and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--policy", choices=POLICIES, default="lane")
    options = parser.parse_args()
    scenario = load_scenario(SCENARIO, demand__duration_s=DURATION_S)
    env, rng = parallel_env(scenario, vary_demand=True), default_rng(1)
    tune_garbage_collector()
    road_s = cpu_s = 0.0
    overlaps = vehicles = 0
    for seed in range(options.episodes):
        began_s = time.process_time()
        observations, infos = env.reset(seed=seed)
        while env.agents:
            actions = _choose(env, options.policy, observations, infos, rng)
            observations, *_, infos = env.step(actions)
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
    env: VehiclesEnv,
    policy: str,
    observations: Mapping[str, Observation],
    infos: Mapping[str, Mapping[str, Any]],
    rng: Generator,
) -> dict[str, int]:
    if policy == "hold":
        return {}
    masks = {name: infos[name]["action_mask"] for name in env.agents}
    if policy == "random":
        return {name: int(rng.choice(np.flatnonzero(mask))) for name, mask in masks.items()}
    wanted = {
        name: env.moves.index((0, int(np.sign(observations[name][TO_TARGET])))) for name in masks
    }
    return {name: action for name, action in wanted.items() if masks[name][action]}


if __name__ == "__main__":
    main()
