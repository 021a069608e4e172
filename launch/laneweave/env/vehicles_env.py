"""The PettingZoo environment in which vehicles request moves of the rolling operation."""

from __future__ import annotations

import logging
import math
import operator
from collections.abc import Iterable, Mapping
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
import structlog
from attrs import evolve
from gymnasium.spaces import Box, Discrete
from numpy.random import SeedSequence
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.planning.rolling.requested_moves import RequestPlanner
from laneweave.coordinator.rolling.checked_planner import Planner, checked, stream_road
from laneweave.env.copies import dumped, loaded
from laneweave.env.episode import Episode
from laneweave.env.observations import OWN, Observation, Observer
from laneweave.env.picture import Picture, road_picture
from laneweave.env.record import EpisodeRecord
from laneweave.env.rewards import Rewards
from laneweave.protocol.config.participants import vehicle_name
from laneweave.protocol.errors import BadInputError, raise_all, unknown_name
from laneweave.protocol.lattice import WAIT, Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import SNAPSHOT_S
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.road.demand import arrivals

SEEDS = 2**31
"""Seeds of episodes are below this number."""

Infos = dict[str, dict[str, Any]]
Stepped = tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], Infos]


class VehiclesEnv(ParallelEnv[str, Observation, int]):
    """Vehicles request moves in each slot; the real protocol makes them or refuses them.

    A step is one slot T_F. The request of a vehicle becomes a move of the next slot if the planner
    can grant it (`RequestPlanner`), a ballot puts it into force, and the vehicle's agent starts it.
    An agent enters `agents` when its vehicle is on the road, and leaves when the vehicle leaves.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "laneweave_vehicles_v0",
        "render_modes": ["rgb_array"],
        "render_fps": 2,
    }

    def __init__(
        self,
        scenario: Scenario,
        rewards: Rewards,
        columns: int,
        *,
        vary_demand: bool,
        render_mode: str | None = None,
    ) -> None:
        """Prepare the spaces; see `parallel_env`."""
        _silence_roles()
        self.scenario = scenario
        self.render_mode = render_mode
        self._rewards = rewards
        self._slot_s = scenario.timing.cycles_s[0]
        road = stream_road(scenario)
        self._planner = RequestPlanner(road)
        self._plan = checked(road, self._planner.plan)
        self._observer = Observer(scenario, road, columns)
        self._stream = () if vary_demand else arrivals(scenario)
        self._varies = vary_demand
        self._count = _bound(scenario) if vary_demand else len(self._stream)
        self.possible_agents = [vehicle_name(number) for number in range(1, self._count + 1)]
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
        self._own: dict[str, Observation] = {}
        """What each vehicle on the road observes of itself."""

    def __getstate__(self) -> bytes:
        """Return the state for `pickle` and `copy`, in an episode with all roles of the run."""
        return dumped(self.__dict__)

    def __setstate__(self, state: bytes) -> None:
        """Restore the state."""
        _silence_roles()
        self.__dict__.update(loaded(state))

    def observation_space(self, agent: str) -> Box:
        """Return the space of observations, which all agents share."""
        del agent
        return self._observation_space

    def action_space(self, agent: str) -> Discrete[np.int64]:
        """Return the space of actions, which all agents share; see `moves`."""
        del agent
        return self._action_space

    @cached_property
    def state_space(self) -> Box:
        """The space of `state`."""
        return Box(-1.0, 1.0, (len(self.possible_agents), 1 + len(OWN)), np.float32)

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
            BadInputError: the seed is negative, or no integer.
        """
        del options
        observations, infos = self._begin(seed)
        self.agents = [*observations]
        return observations, infos

    def step(self, actions: Mapping[str, int]) -> Stepped:
        """Request a move for each vehicle, and advance by one slot, or until a vehicle enters.

        Args:
            actions: index in `moves` by vehicle; vehicles without an action hold. Actions of
                possible agents that are not on the road have no effect.

        Returns:
            Observations, rewards, terminations, truncations and infos of all vehicles that were on
            the road before the step, and of those that have entered.

        Raises:
            BadInputError: an agent or an action does not exist; nothing has changed.
            RuntimeError: `reset` has not been called, or the road clock has stopped.
        """
        episode, moves = self._running, self._moves_of(actions)
        if not self.agents:
            return {}, {}, {}, {}, {}
        stepped = self._proceed({name: moves[name] for name in self.agents if name in moves})
        self.agents = [] if episode.ended else [*episode.vehicles]
        return stepped

    def state(self) -> NDArray[np.float32]:
        """Return the state of all agents, for a critic that is trained centrally.

        Returns:
            One row for each of `possible_agents`, in their order (agents, 1 + len(`OWN`)): 1, then
            what the vehicle observes of itself; zeros without a vehicle on the road.

        Raises:
            RuntimeError: `reset` has not been called.
        """
        _ = self._running
        rows = np.zeros((len(self.possible_agents), 1 + len(OWN)), np.float32)
        for row, agent in zip(rows, self.possible_agents, strict=True):
            vehicle = self._vehicle_of(agent)
            if vehicle in self._own:
                row[0], row[1:] = 1.0, self._own[vehicle]
        return rows

    def render(self) -> Picture | None:
        """Return a picture of the road: uint8 (height, width, 3); None without a render mode.

        Raises:
            RuntimeError: `reset` has not been called.
        """
        if self.render_mode is None:
            return None
        episode = self._running
        return road_picture(self.scenario, episode.vehicles.values(), episode.t_s)

    def close(self) -> None:
        """End the episode; there is nothing to release."""
        self._episode, self.agents = None, []

    def _make_planner(self, scenario: Scenario) -> Planner:
        """Return the planner of the rolling operation, which all coordinators share."""
        del scenario
        return self._plan

    def _vehicle_of(self, agent: str) -> str | None:
        """Return the vehicle that an agent drives now; it need not be on the road."""
        return agent

    def _begin(self, seed: int | None) -> tuple[dict[str, Observation], Infos]:
        """Begin an episode; return observations and infos of the vehicles on the road."""
        if seed is not None:
            if not isinstance(seed, int | np.integer) or seed < 0:
                raise BadInputError("seed", seed, "an integer of at least 0")
            self._seeds = SeedSequence(seed)
        drawn = int(self._seeds.spawn(1)[0].generate_state(1)[0]) % SEEDS
        scenario = evolve(self.scenario, seed=drawn)
        stream = arrivals(scenario)[: self._count] if self._varies else self._stream
        make_coordinator = partial(CoordinatorCore, make_planner=self._make_planner)
        self._episode = Episode(scenario, make_coordinator, stream)
        self._planner.requests, self._planner.granted = {}, {}
        self._slot = -1
        self._refused.clear()
        self._advance()
        return self._observe(self._episode.vehicles)

    def _moves_of(self, actions: Mapping[str, int]) -> dict[str, Cell]:
        """Return the move that each agent has chosen.

        Raises:
            BadInputError: an agent or an action does not exist.
        """
        if not isinstance(actions, Mapping):
            raise BadInputError("actions", actions, "a dict of actions by agent")
        moves: dict[str, Cell] = {}
        errors: list[BadInputError] = []
        possible = self.possible_agents
        known, last = {*possible}, len(self.moves) - 1
        for agent, action in actions.items():
            if agent not in known:
                named = f"agents {possible[0]} to {possible[-1]}" if possible else "no agent"
                errors.append(unknown_name("actions", agent, possible, named))
                continue
            try:
                number = operator.index(action)
            except TypeError:
                number = -1
            if 0 <= number <= last:
                moves[agent] = self.moves[number]
            else:
                errors.append(BadInputError(f"actions[{agent}]", action, f"integers 0 to {last}"))
        raise_all(errors)
        return moves

    def _proceed(self, requests: Mapping[str, Cell]) -> Stepped:
        """Advance to the next choice; return what `step` returns, by vehicle."""
        episode, before = self._running, [*self._chosen]
        self._planner.requests, self._planner.granted = requests, {}
        self._advance()
        granted = self._planner.granted
        self._refused = {
            name for name, move in requests.items() if move != WAIT and name not in granted
        }
        over, trips = episode.ended, episode.record.trips
        rewards = {name: self._reward(name) for name in before}
        left = {name: trips[name].left_s is not None for name in before}
        entered = [] if over else [name for name in episode.vehicles if name not in left]
        rewards |= dict.fromkeys(entered, 0.0)
        left |= dict.fromkeys(entered, False)
        truncated = {name: over and not gone for name, gone in left.items()}
        observations, infos = self._observe(left)
        return observations, rewards, left, truncated, infos

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
        # Copies, because learners may change the observations that they get.
        self._own = {name: values[: len(OWN)].copy() for name, values in seen.items()}
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


def _silence_roles() -> None:
    """Print warnings only, unless the user has configured structlog; roles log in each episode."""
    if not structlog.is_configured():
        warnings_only = structlog.make_filtering_bound_logger(logging.WARNING)
        structlog.configure(wrapper_class=warnings_only)


def _bound(scenario: Scenario) -> int:
    """Return a number of vehicles that fewer than one demand in 10^8 exceeds.

    The mean and six standard deviations of a Poisson distribution; regular headways vary less.
    """
    per_s = sum(inflow.volume_veh_per_h for inflow in scenario.flow.inflows.values()) / 3600.0
    mean = per_s * scenario.demand.duration_s
    return math.ceil(mean + 6.0 * math.sqrt(mean)) + 1
