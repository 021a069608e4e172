"""The environment with slots: a fixed set of agents that drive one vehicle after another."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator, default_rng
from pettingzoo.test import parallel_api_test, parallel_seed_test

from laneweave.env import SlotsEnv, VehiclesEnv, parallel_env
from laneweave.env.observations import OWN
from laneweave.protocol.errors import BadInputError
from support.environments import TINY, any_move, same

FEW = 3
"""Fewer slots than vehicles are on the road at a time."""


def slots_env(slots: int | None = FEW, **options: Any) -> VehiclesEnv:  # noqa: ANN401 (of parallel_env)
    return parallel_env(options.pop("tables", TINY), agents="slots", slots=slots, **options)


def test_api_of_pettingzoo() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(slots_env(vary_demand=True), 12)
        parallel_seed_test(slots_env, 4)


class VectorEnv:
    """One environment per agent, as vector wrappers make them.

    They read the agents and spaces once, before the first reset, and take results of all agents in
    the order of `possible_agents` in every step; an episode ends for all agents at once.
    """

    def __init__(self, env: VehiclesEnv) -> None:
        """Read agents and spaces."""
        self.env, self.agents = env, [*env.possible_agents]
        self.space = env.observation_space(self.agents[0])
        assert all(env.observation_space(agent) == self.space for agent in self.agents)

    def reset(self, seed: int) -> np.ndarray[Any, Any]:
        observations, infos = self.env.reset(seed=seed)
        assert self.env.agents == self.agents
        assert [*infos] == self.agents
        return self._stacked(observations)

    def step(self, actions: np.ndarray[Any, Any]) -> tuple[Any, Any, Any, list[dict[str, Any]]]:
        by_agent = dict(zip(self.agents, actions, strict=True))
        observations, rewards, terminated, truncated, infos = self.env.step(by_agent)
        for each in (observations, rewards, terminated, truncated, infos):
            assert [*each] == self.agents
        ends = [terminated[agent] or truncated[agent] for agent in self.agents]
        assert len({*ends}) == len({*terminated.values()}) == len({*truncated.values()}) == 1
        assert self.env.agents == ([] if ends[0] else self.agents)
        return (
            self._stacked(observations),
            np.array([*rewards.values()], np.float32),
            np.array(ends),
            [*infos.values()],
        )

    def _stacked(self, observations: Mapping[str, Any]) -> np.ndarray[Any, Any]:
        assert all(self.space.contains(one) for one in observations.values())
        return np.stack([observations[agent] for agent in self.agents])


def test_contract_of_vector_wrappers() -> None:
    env = slots_env(vary_demand=True)
    vector, rng = VectorEnv(env), default_rng(1)
    reused = 0
    for seed in range(2):
        before = vector.reset(seed)
        drivers = [None] * FEW
        had: list[set[str]] = [set() for _ in range(FEW)]
        for _ in range(100):
            drivers_before = drivers
            observations, rewards, ends, infos = vector.step(rng.integers(len(env.moves), size=FEW))
            drivers = [info["vehicle"] for info in infos]
            for slot, info in enumerate(infos):
                assert info["occupied"] == (drivers[slot] is not None) == observations[slot].any()
                assert info["action_mask"].dtype == np.int8
                if not before[slot].any():
                    assert rewards[slot] == 0.0
                if drivers[slot] is None:
                    assert info["action_mask"].tolist() == [1] + [0] * (len(env.moves) - 1)
                    assert "cell" not in info
                # Between two vehicles a slot is empty.
                assert drivers_before[slot] in {None, drivers[slot]} or drivers[slot] is None
                if drivers[slot] is not None:
                    had[slot].add(str(drivers[slot]))
            on_road = len(env._running.vehicles)
            waiting = on_road - sum(one is not None for one in drivers)
            assert {info["vehicles_without_slot"] for info in infos} == {waiting}
            before = observations
            if ends.all():
                break
        else:
            pytest.fail("the episode does not end")
        names = [name for each in had for name in each]
        assert len(names) == len({*names})  # no vehicle is in two slots
        reused += sum(len(each) > 1 for each in had)
    assert reused > 1


def test_with_enough_slots_vehicles_drive_as_without_slots() -> None:
    vehicles = parallel_env(TINY)
    env = slots_env(None)
    assert len(env.possible_agents) == len(vehicles.possible_agents)
    rng = default_rng(3)
    seen, infos = env.reset(seed=2)
    expected, _ = vehicles.reset(seed=2)
    total = dict.fromkeys(vehicles.possible_agents, 0.0)
    departed: dict[str, Any] = {}
    while vehicles.agents:
        slot_of = {info["vehicle"]: slot for slot, info in infos.items() if info["occupied"]}
        assert {name: seen[slot].tolist() for name, slot in slot_of.items()} == {
            name: expected[name].tolist() for name in vehicles.agents
        }
        actions = any_move(vehicles, {}, rng)
        chosen = {slot_of[name]: action for name, action in actions.items()}
        seen, rewards, terminated, truncated, infos = env.step(chosen)
        expected, of_vehicles, left, _, infos_of_vehicles = vehicles.step(actions)
        for name, slot in slot_of.items():
            assert rewards[slot] == of_vehicles[name]
            total[name] += rewards[slot]
            if left[name]:
                departed[name] = infos[slot].pop("left")
                assert departed[name].pop("vehicle") == name
                del infos_of_vehicles[name]["action_mask"]
                assert departed[name] == infos_of_vehicles[name]
    assert {*departed} == {*vehicles.possible_agents}
    assert all(terminated.values())
    assert not any(truncated.values())
    assert env.agents == []
    assert env.step({}) == ({}, {}, {}, {}, {})


def test_vehicles_without_a_slot_hold_their_cells() -> None:
    env, rng = slots_env(1), default_rng(1)
    _, infos = env.reset(seed=1)
    cells: dict[str, set[Any]] = {}
    while env.agents:
        driven = infos["slot_0"]["vehicle"]
        for name, vehicle in env._running.vehicles.items():
            if name != driven:
                cells.setdefault(name, set()).add(vehicle.cell)
        if driven is not None:
            cells.pop(driven, None)
        *_, infos = env.step({"slot_0": int(rng.integers(len(env.moves)))})
    assert len(cells) > 3
    assert all(len(each) == 1 for each in cells.values())


def test_slots_are_truncated_together_at_the_limit() -> None:
    env = slots_env(tables=TINY | {"runtime": {"max_road_s": 14.0}})
    env.reset(seed=1)
    while env.agents:
        _, _, terminated, truncated, infos = env.step({})
    assert all(truncated.values())
    assert not any(terminated.values())
    assert any(info["occupied"] for info in infos.values())


def test_state_has_a_row_for_each_slot() -> None:
    env = slots_env()
    observations, infos = env.reset(seed=1)
    for _ in range(2):
        state = env.state()
        assert state.shape == (FEW, 1 + len(OWN))
        assert env.state_space.contains(state)
        for row, slot in zip(state, env.possible_agents, strict=True):
            assert row[0] == infos[slot]["occupied"]
            assert row[1:].tolist() == observations[slot][: len(OWN)].tolist()
        observations, *_, infos = env.step({})
    assert state.any()


def test_a_copy_of_an_environment_with_slots_continues_exactly() -> None:
    def rest(env: VehiclesEnv, rng: Generator) -> list[Any]:
        return [env.step(any_move(env, {}, rng)) for _ in range(3)]

    env = slots_env()
    env.reset(seed=1)
    env.step({})
    copied = copy.deepcopy(env)
    assert isinstance(copied, SlotsEnv)
    assert same(rest(copied, default_rng(1)), rest(env, default_rng(1)))


def test_bad_input() -> None:
    for slots in (0, -1, 10_001, 2.5, "3"):
        with pytest.raises(BadInputError, match="slots"):
            slots_env(slots)  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match="slots: got 3"):
        parallel_env(TINY, slots=3)
    with pytest.raises(BadInputError, match="did you mean slots"):
        parallel_env(TINY, agents="slot")  # type: ignore[arg-type]
    env = slots_env()
    with pytest.raises(RuntimeError, match="reset"):
        env.step({})
    env.reset(seed=1)
    with pytest.raises(BadInputError, match="slot_0 to slot_2"):
        env.step({"slot_4": 0})
    with pytest.raises(BadInputError, match=r"actions\[slot_1\]"):
        env.step({"slot_1": len(env.moves)})
