"""Short episodes of the PettingZoo environment, policies, and comparison of results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.random import Generator, default_rng

from laneweave.env import VehiclesEnv

ROAD = {"s1_m": 75.0, "s2_m": 75.0, "s3_m": 600.0}
DENSE = {"duration_s": 20.0, "volume_veh_per_lane_h": 1800.0}
SHORT: dict[str, Any] = {"road": ROAD, "demand": DENSE}
"""30 vehicles; an episode takes about a second."""
TINY = SHORT | {
    "road": ROAD | {"s3_m": 250.0},
    "demand": {"duration_s": 24.0, "volume_veh_per_lane_h": 600.0},
}
"""A dozen vehicles, of which half are on the road at a time; an episode takes half a second."""
Chosen = dict[str, int]
Policy = Callable[[VehiclesEnv, Mapping[str, Mapping[str, Any]], Generator], Chosen]


def any_move(env: VehiclesEnv, infos: Mapping[str, Mapping[str, Any]], rng: Generator) -> Chosen:
    """Choose among all moves, also those that the road does not allow."""
    del infos
    return {name: int(rng.integers(len(env.moves))) for name in env.agents}


def hold(env: VehiclesEnv, infos: Mapping[str, Mapping[str, Any]], rng: Generator) -> Chosen:
    del infos, rng
    return dict.fromkeys(env.agents, 0)


def play(env: VehiclesEnv, policy: Policy, seed: int) -> list[Any]:
    """Run an episode; return all that `reset` and `step` have returned."""
    rng = default_rng(seed)
    observations, infos = env.reset(seed=seed)
    results: list[Any] = [(observations, infos)]
    while env.agents:
        results.append(env.step(policy(env, infos, rng)))
        infos = results[-1][-1]
    return results


def same(one: object, other: object) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)) and isinstance(other, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and np.array_equal(one, other)
    return one == other
