"""The PettingZoo environment in which vehicles request moves of the rolling operation."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import structlog
from attrs import evolve
from gymnasium.spaces import Box, Discrete
from numpy.random import SeedSequence
from pettingzoo import ParallelEnv

from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.planning.rolling.requested_moves import RequestPlanner
from laneweave.coordinator.rolling.checked_planner import Planner, checked, stream_road
from laneweave.env.episode import Episode
from laneweave.env.observations import Observation, Observer
from laneweave.env.record import EpisodeRecord
from laneweave.env.rewards import Rewards
from laneweave.protocol.config.participants import vehicle_name
from laneweave.protocol.config.scenario_files import load_scenario, scenario_of, to_tables
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import WAIT, Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import SNAPSHOT_S
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.road.demand import arrivals

ROLLING = {"formation__operation": "rolling", "runtime__coordinators": 1}
"""Values of the scenario that the environment sets."""
SEEDS = 2**31
"""Seeds of episodes are below this number."""

Infos = dict[str, dict[str, Any]]
Stepped = tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], Infos]


def parallel_env(
    scenario: Scenario | Path | str | Mapping[str, Any] | None = None,
    *,
    rewards: Rewards | None = None,
    columns: int = 3,
    vary_demand: bool = False,
) -> VehiclesEnv:
    """Return a PettingZoo `ParallelEnv` in which the agents are vehicles.

    Args:
        scenario: a scenario, its file or its tables; None: the paper's road. The environment runs
            it with the rolling operation and one coordinator.
        rewards: weights of the reward; None: the defaults.
        columns: number of columns of cells that a vehicle observes ahead, and behind; 1 to 20.
        vary_demand: whether each episode draws its own vehicles. False: every episode has the
            vehicles of the scenario's seed, and the seed of `reset` changes the rest: measurement
            errors and the delays of messages.

    Raises:
        BadInputError: the scenario or a value is invalid; the scenario has a SUMO simulation.
    """
    if not 1 <= columns <= 20:
        raise BadInputError("columns", columns, "1 to 20")
    if isinstance(scenario, Scenario):
        settings = scenario_of(to_tables(scenario), **ROLLING)
    elif isinstance(scenario, Mapping):
        settings = scenario_of(scenario, **ROLLING)
    else:
        settings = load_scenario(None if scenario is None else Path(scenario), **ROLLING)
    if settings.sumo.config:
        raise BadInputError("sumo.config", settings.sumo.config, "none: there is no SUMO here")
    if not structlog.is_configured():
        # Else the roles would print lines in each episode.
        warnings_only = structlog.make_filtering_bound_logger(logging.WARNING)
        structlog.configure(wrapper_class=warnings_only)
    return VehiclesEnv(settings, rewards or Rewards(), columns, vary_demand=vary_demand)


class VehiclesEnv(ParallelEnv[str, Observation, int]):
    """Vehicles request moves in each slot; the real protocol makes them or refuses them.

    A step is one slot T_F. The request of a vehicle becomes a move of the next slot if the planner
    can grant it (`RequestPlanner`), a ballot puts it into force, and the vehicle's agent starts it.
    An agent enters `agents` when its vehicle is on the road, and leaves when the vehicle leaves.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "laneweave_vehicles_v0", "render_modes": []}
    render_mode = None

    def __init__(
        self, scenario: Scenario, rewards: Rewards, columns: int, *, vary_demand: bool
    ) -> None:
        """Prepare the spaces; see `parallel_env`."""
        self.scenario = scenario
        self._rewards = rewards
        self._slot_s = scenario.timing.cycles_s[0]
        road = stream_road(scenario)
        self._planner = RequestPlanner(road)
        self._plan = checked(road, self._planner.plan)
        self._observer = Observer(scenario, road, columns)
        self._stream = () if vary_demand else arrivals(scenario)
        self._varies = vary_demand
        count = _bound(scenario) if vary_demand else len(self._stream)
        self.possible_agents = [vehicle_name(number) for number in range(1, count + 1)]
        self.agents: list[str] = []
        self.moves = self._observer.moves
        """Displacement (columns, lanes) of each action."""
        self._observation_space = Box(-1.0, 1.0, (self._observer.size,), np.float32)
        self._action_space = Discrete(len(self.moves))
        self._seeds = SeedSequence(scenario.seed)
        self._episode: Episode | None = None
        self._slot = -1
        """Slot in which the vehicles choose now, for the slot after it."""
        self._chosen: dict[str, tuple[Cell | tuple[None, int], float, float]] = {}
        """Cell, road time and discomfort of each vehicle when it chose."""
        self._refused: set[str] = set()

    def observation_space(self, agent: str) -> Box:
        """Return the space of observations, which all agents share."""
        del agent
        return self._observation_space

    def action_space(self, agent: str) -> Discrete[np.int64]:
        """Return the space of actions, which all agents share; see `moves`."""
        del agent
        return self._action_space

    @property
    def record(self) -> EpisodeRecord:
        """Trips, overlaps and counts of events of the current episode.

        Raises:
            RuntimeError: `reset` has not been called.
        """
        return self._running.record

    @property
    def t_s(self) -> float:
        """Road time [s].

        Raises:
            RuntimeError: `reset` has not been called.
        """
        return self._running.t_s

    @property
    def _running(self) -> Episode:
        if self._episode is None:
            raise RuntimeError("call reset first")
        return self._episode

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], Infos]:
        """Begin an episode, and advance to the first slot with a vehicle on the road.

        Args:
            seed: determines this episode and all later ones without seeds of their own; at first
                that of the scenario.
            options: ignored.

        Raises:
            BadInputError: the seed is negative.
        """
        del options
        if seed is not None:
            if seed < 0:
                raise BadInputError("seed", seed, "at least 0")
            self._seeds = SeedSequence(seed)
        drawn = int(self._seeds.spawn(1)[0].generate_state(1)[0]) % SEEDS
        scenario = evolve(self.scenario, seed=drawn)
        stream = arrivals(scenario)[: len(self.possible_agents)] if self._varies else self._stream
        make_coordinator = partial(CoordinatorCore, make_planner=self._make_planner)
        self._episode = Episode(scenario, make_coordinator, stream)
        self._planner.requests, self._planner.granted = {}, {}
        self._slot = -1
        self._refused.clear()
        self._advance()
        self.agents = [*self._episode.vehicles]
        return self._observe(self.agents)

    def step(self, actions: dict[str, int]) -> Stepped:
        """Request a move for each vehicle, and advance by one slot, or until a vehicle enters.

        Args:
            actions: index in `moves` by vehicle; vehicles without an action hold.

        Returns:
            Observations, rewards, terminations, truncations and infos of all vehicles that were on
            the road before the step, and of those that have entered.

        Raises:
            BadInputError: there is no such action.
            RuntimeError: `reset` has not been called, or the road clock has stopped.
        """
        episode, before = self._running, self.agents
        requests = {name: self._move(name, actions[name]) for name in before if name in actions}
        if not before:
            return {}, {}, {}, {}, {}
        self._planner.requests, self._planner.granted = requests, {}
        self._advance()
        granted = self._planner.granted
        self._refused = {
            name for name, move in requests.items() if move != WAIT and name not in granted
        }
        over, trips = episode.ended, episode.record.trips
        rewards = {name: self._reward(name) for name in before}
        left = {name: trips[name].left_s is not None for name in before}
        self.agents = [] if over else [*episode.vehicles]
        entered = [name for name in self.agents if name not in left]
        rewards |= dict.fromkeys(entered, 0.0)
        left |= dict.fromkeys(entered, False)
        truncated = {name: over and not gone for name, gone in left.items()}
        observations, infos = self._observe(left)
        return observations, rewards, left, truncated, infos

    def close(self) -> None:
        """End the episode; there is nothing to release."""
        self._episode, self.agents = None, []

    def _make_planner(self, scenario: Scenario) -> Planner:
        """Return the planner of the rolling operation, which all coordinators share."""
        del scenario
        return self._plan

    def _move(self, vehicle: str, action: int) -> Cell:
        if not 0 <= action < len(self.moves):
            raise BadInputError(f"actions[{vehicle}]", action, f"0 to {len(self.moves) - 1}")
        return self.moves[action]

    def _advance(self) -> None:
        """Advance to the next time at which vehicles choose, with a vehicle on the road."""
        episode = self._running
        episode.advance(self._chooses)
        while not episode.ended and not episode.vehicles:
            episode.advance(self._chooses)

    def _chooses(self) -> bool:
        """Return whether the last tick was the first after the snapshot of a slot.

        The coordinator plans in the next tick, from the states up to this one.
        """
        t_s = self._running.t_s
        slot = math.floor(t_s / self._slot_s + 1e-9)
        if slot == self._slot or t_s <= slot * self._slot_s + SNAPSHOT_S + 1e-6:
            return False
        self._slot = slot
        return True

    def _reward(self, name: str) -> float:
        """Return the reward of a vehicle since it chose."""
        episode = self._running
        trip, vehicle = episode.record.trips[name], episode.vehicles.get(Name(name))
        cell, since_s, discomfort = self._chosen[name]
        until_s = episode.t_s if trip.left_s is None else trip.left_s
        return self._rewards.of_step(
            until_s - since_s,
            moved=vehicle is not None and vehicle.cell != cell,
            discomfort=trip.discomfort - discomfort,
            left=None if trip.left_s is None else trip,
        )

    def _observe(self, names: Iterable[str]) -> tuple[dict[str, Observation], Infos]:
        """Return the observations and infos of vehicles; those that have left observe zeros."""
        episode = self._running
        vehicles, trips, t_s = episode.vehicles, episode.record.trips, episode.t_s
        seen = self._observer.observe(vehicles, self._refused, t_s)
        masks = self._observer.masks(vehicles, self._slot + 1)
        self._chosen = {
            name: (vehicle.cell, t_s, trips[name].discomfort) for name, vehicle in vehicles.items()
        }
        infos: Infos = {}
        for name in names:
            trip = trips[name]
            if trip.left_s is None:
                infos[name] = {
                    "action_mask": masks[name],
                    "cell": vehicles[Name(name)].cell,
                    "refused": name in self._refused,
                }
            else:
                infos[name] = {
                    "action_mask": self._observer.only_hold(),
                    "at_destination": trip.at_destination,
                    "travel_time_s": trip.left_s - trip.entered_s,
                }
        gone = np.zeros(self._observer.size, np.float32)
        return {name: seen.get(name, gone) for name in names}, infos


def _bound(scenario: Scenario) -> int:
    """Return a number of vehicles that fewer than one demand in 10^8 exceeds.

    The mean and six standard deviations of a Poisson distribution; regular headways vary less.
    """
    per_s = sum(inflow.volume_veh_per_h for inflow in scenario.flow.inflows.values()) / 3600.0
    mean = per_s * scenario.demand.duration_s
    return math.ceil(mean + 6.0 * math.sqrt(mean)) + 1
