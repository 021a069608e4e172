"""The environment: PettingZoo's tests, repeatability, safety under any action, effects, rewards."""

from __future__ import annotations

import itertools
import subprocess
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator, default_rng
from pettingzoo.test import parallel_api_test, parallel_seed_test

from laneweave.env import Rewards, VehiclesEnv, parallel_env
from laneweave.env.observations import OWN, PER_CELL
from laneweave.env.record import EpisodeRecord, Trip
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.sim_bridge.road.demand import arrivals
from support.environments import (
    ROAD,
    SHORT,
    Chosen,
    Policy,
    any_move,
    hold,
    play,
    same,
)
from support.variants import variants

ROOT = Path(__file__).parents[3]


def into_others(env: VehiclesEnv, infos: Mapping[str, Mapping[str, Any]], rng: Generator) -> Chosen:
    """Let each vehicle that has a neighbour move into its cell, so that neighbours swap."""
    cells = {infos[name]["cell"] for name in env.agents}
    chosen = {}
    for name in env.agents:
        column, lane = infos[name]["cell"]
        taken = [
            number
            for number, (columns, lanes) in enumerate(env.moves)
            if number and (column + columns, lane + lanes) in cells
        ]
        chosen[name] = int(rng.choice(taken)) if taken else int(rng.integers(len(env.moves)))
    return chosen


def into_one_lane(
    env: VehiclesEnv, infos: Mapping[str, Mapping[str, Any]], rng: Generator
) -> Chosen:
    """Let all vehicles crowd into lane 1 and close up to each other."""
    chosen = {}
    for name in env.agents:
        lane = infos[name]["cell"][1]
        wanted = (0, int(np.sign(1 - lane))) if lane != 1 else ((1, 0), (-1, 0))[rng.integers(2)]
        chosen[name] = env.moves.index(wanted)
    return chosen


@pytest.mark.parametrize(
    ("vary_demand", "cycles"), variants([(True, 2), (True, 500), (False, 500)])
)
def test_api_of_pettingzoo(cycles: int, *, vary_demand: bool) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if vary_demand:  # an episode need not have the largest possible number of vehicles
            warnings.filterwarnings("ignore", "No agents present but not all possible_agents")
        parallel_api_test(parallel_env(SHORT, vary_demand=vary_demand), cycles)
        parallel_seed_test(lambda: parallel_env(SHORT, vary_demand=vary_demand), cycles)


@pytest.fixture(scope="module")
def held() -> tuple[VehiclesEnv, list[Any]]:
    """Return an environment in which all vehicles held, and its results."""
    weights = Rewards(arrived=10.0, missed=-20.0, second=-1.0, move=0.0, discomfort=0.0)
    env = parallel_env(SHORT, rewards=weights)
    return env, play(env, hold, 1)


@pytest.mark.more
@pytest.mark.more
def test_possible_agents_are_the_demanded_vehicles(held: tuple[VehiclesEnv, list[Any]]) -> None:
    env, _ = held
    assert env.possible_agents == [one.vehicle for one in arrivals(env.scenario)]
    assert [*env.record.trips] != []
    assert {*env.record.trips} == {*env.possible_agents}


@pytest.mark.more
def test_varied_demands_are_within_the_possible_agents() -> None:
    env = parallel_env(SHORT, vary_demand=True)
    entered = []
    for seed in range(3):
        play(env, hold, seed)
        assert {*env.record.trips} <= {*env.possible_agents}
        entered.append([trip.entered_s for trip in env.record.trips.values()])
    assert entered[0] != entered[1] != entered[2]


@pytest.mark.more
def test_same_seed_gives_the_same_episode_also_beside_another_one() -> None:
    one, other = parallel_env(SHORT), parallel_env(SHORT)
    first = play(one, any_move, 5)
    play(one, any_move, 6)
    rng, disturbing = default_rng(5), default_rng(0)
    observations, infos = one.reset(seed=5)
    _, others = other.reset(seed=9)
    second: list[Any] = [(observations, infos)]
    while one.agents:
        second.append(one.step(any_move(one, infos, rng)))
        infos = second[-1][-1]
        others = other.step(any_move(other, others, disturbing))[-1]
    assert same(first, second)
    assert not same(first, play(one, any_move, 7))


def test_episodes_without_seeds_differ_but_repeat_after_the_same_first_seed() -> None:
    env = parallel_env(SHORT)
    pairs = []
    for _ in range(2):
        env.reset(seed=4)
        pairs.append([env.reset()[0], env.reset()[0]])
    assert same(pairs[0], pairs[1])
    assert not same(pairs[0][0], pairs[0][1])


STRAIGHT = pytest.param(SHORT, id="straight")
OBLIQUE = pytest.param(
    SHORT | {"formation": {"mode": 2, "conflicts": ["geometric"]}}, id="oblique moves"
)
LANE_DROP = pytest.param(
    SHORT | {"road": ROAD | {"closures": [{"lane": 0, "from_m": 550.0, "to_m": 750.0}]}},
    id="lane drop",
)


@pytest.mark.more
@pytest.mark.parametrize("policy", variants([any_move, into_others, into_one_lane]))
@pytest.mark.parametrize("tables", variants([LANE_DROP, STRAIGHT, OBLIQUE]))
def test_no_action_makes_bodies_overlap(
    policy: Policy, tables: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    closest_m: list[float] = []
    measure = EpisodeRecord.on_positions

    def check(record: EpisodeRecord, t_s: float, vehicles: Any, **measured: Any) -> None:  # noqa: ANN401
        states = [vehicle.state for vehicle in vehicles]
        for one, two in itertools.combinations(states, 2):
            # Bodies of 5 m by 1.8 m side by side or in line, as an observer beside the road sees.
            along_m, across_m = abs(one[0] - two[0]) - 5.0, abs(one[3] - two[3]) - 1.8
            closest_m.append(max(along_m, across_m))
        measure(record, t_s, vehicles, **measured)

    monkeypatch.setattr(EpisodeRecord, "on_positions", check)
    env = parallel_env(tables)
    play(env, policy, 1)
    assert env.record.overlaps == []
    assert min(closest_m) > 0.5
    assert env.record.planning_errors == []
    assert env.record.events["stream-planned"] > 5
    if policy is any_move:
        assert env.record.events["plan-in-force"] > 0  # `into_others` may get nothing at all
    assert {*env.record.trips} == {*env.possible_agents}
    assert all(trip.left_s is not None for trip in env.record.trips.values())


@pytest.mark.more
def test_granted_requests_are_driven_and_others_are_not() -> None:
    env = parallel_env(SHORT)
    _, infos = env.reset(seed=1)
    moved = refused = 0
    rng = default_rng(1)
    while env.agents:
        before = {name: infos[name]["cell"] for name in env.agents}
        actions = {
            name: int(rng.choice(np.flatnonzero(infos[name]["action_mask"]))) for name in before
        }
        _, _, left, _, infos = env.step(actions)
        for name, action in actions.items():
            if left[name] or not action:
                continue
            columns, lanes = env.moves[action]
            column, lane = before[name]
            if infos[name]["refused"]:
                refused += 1
                assert infos[name]["cell"] == before[name]
            elif infos[name]["cell"] != before[name]:
                moved += 1
                assert infos[name]["cell"] == (column + columns, lane + lanes)
    assert moved > 50
    assert refused > 5


@pytest.mark.more
def test_opposite_requests_have_opposite_effects() -> None:
    lanes = {}
    for side in (-1, 1):
        env = parallel_env(SHORT)

        def choose(env: VehiclesEnv, infos: object, rng: object, side: int = side) -> Chosen:
            del infos, rng
            return dict.fromkeys(env.agents, env.moves.index((0, side)))

        results = play(env, choose, 1)
        lanes[side] = np.mean(
            [info["cell"][1] for *_, infos in results for info in infos.values() if "cell" in info]
        )
    assert lanes[1] > lanes[-1] + 0.5


@pytest.mark.more
def test_who_holds_stays_in_its_cell_and_arrives_only_if_it_entered_in_its_lane(
    held: tuple[VehiclesEnv, list[Any]],
) -> None:
    env, results = held
    entered = {one.vehicle: one for one in arrivals(env.scenario)}
    cells: dict[str, set[Any]] = {}
    for *_, infos in results:
        for name, info in infos.items():
            if "cell" in info:
                cells.setdefault(name, set()).add(info["cell"])
            else:
                arrival = entered[name]
                assert info["at_destination"] == (arrival.lane == arrival.preferred_lane)
                assert info["travel_time_s"] == pytest.approx(750 / 15, abs=2.0)
    assert all(len(each) == 1 for each in cells.values())


@pytest.mark.more
def test_rewards_sum_up_over_a_trip(held: tuple[VehiclesEnv, list[Any]]) -> None:
    env, results = held
    total: dict[str, float] = {}
    for _, rewards, _, _, _ in results[1:]:
        for name, reward in rewards.items():
            total[name] = total.get(name, 0.0) + reward
    assert {*total} == {*env.possible_agents}
    for name, trip in env.record.trips.items():
        assert trip.left_s is not None
        seconds = (10.0 if trip.at_destination else -20.0) - total[name]
        # It has been an agent since the first choice after it had entered.
        assert trip.left_s - trip.entered_s - 6.1 < seconds <= trip.left_s - trip.entered_s + 1e-6


def test_reward_of_a_step() -> None:
    weights = Rewards(arrived=10.0, missed=-20.0, second=-1.0, move=-2.0, discomfort=-3.0)
    assert weights.of_step(4.0, moved=False, discomfort=0.0, left=None) == -4.0
    assert weights.of_step(4.0, moved=True, discomfort=0.5, left=None) == -7.5
    assert weights.of_step(1.0, moved=False, discomfort=0.0, left=Trip(0.0, 9.0, True)) == 9.0
    assert weights.of_step(1.0, moved=False, discomfort=0.0, left=Trip(0.0, 9.0, False)) == -21.0


def test_observations_and_masks_of_a_vehicle_alone() -> None:
    demand = {"duration_s": 10.0, "volume_veh_per_lane_h": 3.0, "min_headway_s": 0.0}
    tables = SHORT | {
        "demand": demand,
        "sensing": dict.fromkeys(
            ("position_noise_m", "speed_noise_mps", "accel_noise_mps2", "lateral_noise_m"), 0.0
        ),
    }
    env = next(
        env
        for seed in itertools.count()
        if len((env := parallel_env(tables | {"seed": seed})).possible_agents) == 1
    )
    results = play(env, hold, 1)
    (arrival,) = arrivals(env.scenario)
    space = env.observation_space("v0001")
    for step, result in enumerate(results[:-1]):
        observation, info = result[0]["v0001"], result[-1]["v0001"]
        assert space.contains(observation)
        own = dict(zip(OWN, observation, strict=False))
        assert own["lane"] == pytest.approx(arrival.lane / 2)
        assert own["to_target"] == pytest.approx((arrival.preferred_lane - arrival.lane) / 2)
        assert abs(own["speed"]) < 0.2
        around = observation[len(OWN) :].reshape(7, 3, len(PER_CELL))
        occupied = np.argwhere(around[:, :, 0])
        assert occupied.tolist() == [[3, arrival.lane]]
        allowed = [move for move, one in zip(env.moves, info["action_mask"], strict=True) if one]
        assert (0, 0) in allowed
        if step == 0:
            assert allowed == [(0, 0)]  # S3 begins 150 m from the start
        if own["position"] > 0.3 and own["to_end"] > 0.3:
            assert ((0, -1) in allowed) == (arrival.lane > 0)
            assert ((0, 1) in allowed) == (arrival.lane < 2)
            assert {(1, 0), (-1, 0)} <= {*allowed}
    assert not results[-1][0]["v0001"].any()


@pytest.mark.more
def test_vehicles_on_the_road_at_the_limit_are_truncated() -> None:
    env = parallel_env(SHORT | {"runtime": {"max_road_s": 40.0}})
    results = play(env, hold, 1)
    _, _, left, truncated, _ = results[-1]
    assert any(truncated.values())
    assert all(truncated[name] != left[name] for name in left)
    assert env.t_s == pytest.approx(40.0)
    assert env.step({}) == ({}, {}, {}, {}, {})


def test_files_scenarios_and_tables_give_the_same_environment() -> None:
    path = ROOT / "scenarios" / "demo.toml"
    of_file, of_scenario = parallel_env(str(path)), parallel_env(load_scenario(path))
    assert of_file.scenario == of_scenario.scenario
    assert of_file.scenario.formation.operation == "rolling"
    assert same(of_file.reset(seed=1), of_scenario.reset(seed=1))


def test_bad_input() -> None:
    with pytest.raises(BadInputError, match="columns"):
        parallel_env(SHORT, columns=0)
    for wrong in (2.5, "3", True):
        with pytest.raises(BadInputError, match="columns"):
            parallel_env(SHORT, columns=wrong)  # type: ignore[arg-type]
    for seed in (1.5, "a", -1):
        with pytest.raises(BadInputError, match="seed"):
            parallel_env(SHORT).reset(seed=seed)  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match="sumo"):
        parallel_env({"sumo": {"config": "x.sumocfg", "corridor": "a:b"}})
    with pytest.raises(BadInputError, match=r"radio\.technology: got 'c-v2x'"):
        parallel_env({"radio": {"technology": "c-v2x"}})
    env = parallel_env(SHORT)
    with pytest.raises(RuntimeError, match="reset"):
        env.step({})
    with pytest.raises(BadInputError, match="seed"):
        env.reset(seed=-1)
    env.reset(seed=1)
    with pytest.raises(BadInputError, match="actions"):
        env.step({env.agents[0]: 5})
    env.close()
    assert env.agents == []


@pytest.mark.slow
@pytest.mark.more
def test_example() -> None:
    command = [sys.executable, str(ROOT / "examples" / "pettingzoo_env.py")]
    scenario = str(ROOT / "scenarios" / "demo.toml")
    done = subprocess.run([*command, scenario], capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert lines[0].endswith("of 91 vehicles in their lanes")
    assert int(lines[0].split()[0]) > 60
    assert lines[1].endswith("overlaps: 0")
