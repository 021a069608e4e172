"""Copies of the environment: at any time, exact, independent, and of all kinds of objects."""

from __future__ import annotations

import copy
import itertools
import pickle
import subprocess
import sys
from collections.abc import Callable
from functools import cache, lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng

from laneweave.agents.driving.tracking_problem import (
    NO_GAPS,
    ConstraintBounds,
    ProgramKind,
    TrackingProgram,
    shared_program,
)
from laneweave.env import VehiclesEnv, parallel_env
from laneweave.env.copies import dumped, loaded
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.topics import BRIDGE_ALIVE
from support.environments import ROAD, SHORT, TINY, any_move, hold, play, same
from support.variants import variants

LANE_DROP = SHORT | {
    "road": ROAD | {"s3_m": 300.0, "closures": [{"lane": 0, "from_m": 300.0, "to_m": 450.0}]},
    "demand": {"duration_s": 10.0, "volume_veh_per_lane_h": 1800.0},
}
"""Vehicles in lane 0 brake before the stop line, for which agents need OSQP."""


def by_pickle(env: VehiclesEnv) -> VehiclesEnv:
    copied: VehiclesEnv = pickle.loads(pickle.dumps(env))  # noqa: S301 (written here)
    return copied


HOW = pytest.mark.parametrize("make", [by_pickle, copy.deepcopy])
Copy = Callable[[VehiclesEnv], VehiclesEnv]


@HOW
def test_a_copy_before_the_first_reset(make: Copy) -> None:
    env = parallel_env(TINY)
    copied = make(env)
    assert same(copied.reset(seed=3), env.reset(seed=3))
    assert copied.possible_agents == env.possible_agents
    assert copied.observation_space("v0001") == env.observation_space("v0001")


def begin(env: VehiclesEnv, steps: int) -> np.random.Generator:
    """Reset an environment, and make some steps; return the generator of the actions."""
    rng = default_rng(1)
    env.reset(seed=1)
    for _ in range(steps):
        env.step(any_move(env, {}, rng))
    return rng


def rest(env: VehiclesEnv, rng: np.random.Generator) -> list[Any]:
    """Return the results of all further steps, and of the next reset."""
    results: list[Any] = []
    while env.agents:
        results.append(env.step(any_move(env, {}, rng)))
        results.append(env.state())
    return [*results, env.record.trips, env.record.events, env.reset()]


@pytest.mark.parametrize(("make", "steps"), variants([(by_pickle, 2), (copy.deepcopy, 1)]))
def test_a_copy_in_an_episode_continues_exactly_as_the_original(make: Copy, steps: int) -> None:
    env = parallel_env(TINY, vary_demand=True)
    rng = begin(env, steps)
    copied = make(env)
    # Copies of copies, and the copy first: it must not change the original.
    again = make(copied)
    of_copy = rest(copied, copy.deepcopy(rng))
    of_original = rest(env, copy.deepcopy(rng))
    assert len(of_original) > 6
    assert same(of_copy, of_original)
    assert same(rest(again, rng), of_original)


def test_copies_share_the_program_and_solves_do_not_depend_on_earlier_ones() -> None:
    scenario = Scenario()
    n, tick_s = scenario.timing.horizon_ticks, scenario.runtime.tick_s
    kind = ProgramKind(n, tick_s, scenario.formation.speed_mps, scenario.vehicle)
    program = shared_program(kind)
    assert loaded(dumped(program)) is program
    states, jerks = np.zeros((n + 1, 6)), np.zeros((n, 2))
    states[:, 1] = 15.0
    rng = default_rng(2)
    iterations = set()
    for spread in (0.3, 3.0) * 6:
        error = tuple(rng.normal(0.0, spread, 6).tolist())
        new = TrackingProgram(kind)
        for one in (program, new):
            one.write_bounds(error, states, jerks, None, NO_GAPS)
        expected, got = new.solve(error), program.solve(error)
        assert expected.iterations == got.iterations
        assert expected.x.tobytes() == got.x.tobytes()
        iterations.add(expected.iterations)
    assert 1 in iterations  # no limit binds
    assert max(iterations) > 4


@pytest.mark.parametrize(("make", "limit_s"), [(copy.deepcopy, 12.0), (by_pickle, 600.0)])
def test_a_copy_after_the_end_begins_the_same_next_episode(make: Copy, limit_s: float) -> None:
    # After 12 s vehicles are still on the road; at the other end the next plan is pending.
    env = parallel_env(TINY | {"runtime": {"max_road_s": limit_s}}, vary_demand=True)
    play(env, hold, 1)
    copied = make(env)
    assert copied.agents == []
    assert copied.step({}) == ({}, {}, {}, {}, {})
    assert same(copied.record.trips, env.record.trips)
    assert same(copied.reset(), env.reset())


@pytest.mark.slow
@pytest.mark.more
def test_a_copy_in_another_process_continues_exactly(tmp_path: Path) -> None:
    env = parallel_env(TINY)
    begin(env, 1)
    (tmp_path / "env.pickle").write_bytes(pickle.dumps(env))
    script = (
        "import pickle, sys; from pathlib import Path; folder = Path(sys.argv[1]);"
        "env = pickle.loads((folder / 'env.pickle').read_bytes());"
        "stepped = [env.step(dict.fromkeys(env.agents, 3)) for _ in range(3)];"
        "(folder / 'results.pickle').write_bytes(pickle.dumps(stepped))"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == ""
    results = pickle.loads((tmp_path / "results.pickle").read_bytes())  # noqa: S301
    assert same(results, [env.step(dict.fromkeys(env.agents, 3)) for _ in range(3)])


# --- copies of single objects -------------------------------------------------------------------


def test_views_stay_views_of_one_array() -> None:
    for original in (np.arange(24.0).reshape(4, 6), np.asfortranarray(np.ones((4, 6)))):
        parts = [original, original[1:3, ::2], original[::-1].T, original[2:][:, 1:]]
        for copies in (loaded(dumped(parts)), loaded(dumped(loaded(dumped(parts))))):
            assert same(copies, parts)
            copies[0][2, 4] = 99.0
            assert copies[1][1, 2] == copies[2][4, 1] == copies[3][0, 3] == 99.0
        assert 99.0 not in original
    bounds = loaded(dumped(ConstraintBounds(5)))
    bounds.gap[:] = 7.0
    assert bounds.all[-5:].tolist() == [7.0] * 5


@cache
def twice(number: int) -> int:
    return 2 * number


def test_constants_caches_counters_and_read_only_mappings() -> None:
    counter = itertools.count(3)
    next(counter)
    cached = lru_cache(maxsize=7)(partial(pow, 2))
    cached(5)
    state = [BRIDGE_ALIVE, counter, counter.__next__, MappingProxyType({"a": 1}), cached, twice]
    topic, copied, following, read_only, power, same_function = loaded(dumped(state))
    assert topic is BRIDGE_ALIVE
    assert [next(copied), following(), next(counter)] == [4, 5, 4]
    assert read_only == {"a": 1}
    assert isinstance(read_only, MappingProxyType)
    assert power.cache_info()[1:] == (0, 7, 0)
    assert power(5) == 32
    assert same_function is twice
