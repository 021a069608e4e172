"""The PettingZoo environment with a fixed set of agents, for libraries that need one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import numpy as np

from laneweave.env.observations import Observation
from laneweave.env.rewards import Rewards
from laneweave.env.vehicles_env import Infos, Stepped, VehiclesEnv
from laneweave.protocol.scenario.fields import Scenario


class SlotsEnv(VehiclesEnv):
    """The agents are slots, each of which drives one vehicle at a time, or none.

    All slots are agents from `reset` to the end, and end in the same step. Vehicles take free slots
    in the order in which they enter the road; without a free slot they hold their cells until there
    is one. Between two vehicles a slot is empty for at least one step, so that no observation of
    the next vehicle comes with the last reward of the previous one.
    """

    metadata: ClassVar[dict[str, Any]] = VehiclesEnv.metadata | {"name": "laneweave_slots_v0"}

    def __init__(
        self,
        scenario: Scenario,
        rewards: Rewards,
        columns: int,
        *,
        vary_demand: bool,
        slots: int | None,
        render_mode: str | None = None,
    ) -> None:
        """Prepare the spaces; see `parallel_env`."""
        super().__init__(
            scenario, rewards, columns, vary_demand=vary_demand, render_mode=render_mode
        )
        count = len(self.possible_agents) if slots is None else slots
        self.possible_agents = [f"slot_{number}" for number in range(count)]
        self._vehicle_in: dict[str, str | None] = {}

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], Infos]:
        """Begin an episode, and advance to the first slot T_F with a vehicle on the road.

        Args:
            seed: see `VehiclesEnv.reset`.
            options: ignored.

        Returns:
            Observations and infos of all slots.

        Raises:
            BadInputError: the seed is negative, or no integer.
        """
        del options
        observations, infos = self._begin(seed)
        self.agents = [*self.possible_agents]
        self._vehicle_in = dict.fromkeys(self.agents)
        self._fill(self.agents)
        return self._by_slot(observations), self._infos(infos, {})

    def step(self, actions: Mapping[str, int]) -> Stepped:
        """Request a move for the vehicle in each slot; advance as `VehiclesEnv.step` does.

        Args:
            actions: index in `moves` by slot; vehicles in slots without an action hold. Actions of
                empty slots have no effect.

        Returns:
            Observations, rewards, terminations, truncations and infos of all slots. Empty slots
            observe zeros. The reward is that of the vehicle that was in the slot before the step.
            At the end of the episode all slots are truncated if a vehicle is still on the road, and
            else terminated.

        Raises:
            BadInputError: an agent or an action does not exist; nothing has changed.
            RuntimeError: `reset` has not been called, or the road clock has stopped.
        """
        episode, moves, slots = self._running, self._moves_of(actions), self.agents
        if not slots:
            return {}, {}, {}, {}, {}
        held = {slot: vehicle for slot, vehicle in self._vehicle_in.items() if vehicle is not None}
        requests = {vehicle: moves[slot] for slot, vehicle in held.items() if slot in moves}
        observations, of_vehicles, left, truncated, infos = self._proceed(requests)
        over, cut = episode.ended, any(truncated.values())
        rewards = dict.fromkeys(slots, 0.0)
        rewards |= {slot: of_vehicles[vehicle] for slot, vehicle in held.items()}
        departed = {slot: vehicle for slot, vehicle in held.items() if left[vehicle]}
        self._vehicle_in |= dict.fromkeys(departed)
        if over:
            self.agents = []
        else:
            self._fill(slot for slot in slots if slot not in held)
        return (
            self._by_slot(observations),
            rewards,
            dict.fromkeys(slots, over and not cut),
            dict.fromkeys(slots, over and cut),
            self._infos(infos, departed),
        )

    def _vehicle_of(self, agent: str) -> str | None:
        return self._vehicle_in.get(agent)

    def _without_slot(self) -> list[str]:
        """Return the vehicles on the road without a slot, in the order in which they entered."""
        held = {*self._vehicle_in.values()}
        return [name for name in self._running.vehicles if name not in held]

    def _fill(self, free: Iterable[str]) -> None:
        """Assign the vehicles without a slot to free slots."""
        self._vehicle_in |= dict(zip(free, self._without_slot(), strict=False))

    def _by_slot(self, observations: Mapping[str, Observation]) -> dict[str, Observation]:
        """Return the observations of all slots."""
        size = self._observer.size
        return {
            slot: np.zeros(size, np.float32) if vehicle is None else observations[vehicle]
            for slot, vehicle in self._vehicle_in.items()
        }

    def _infos(self, infos: Infos, departed: Mapping[str, str]) -> Infos:
        """Return the infos of all slots.

        Args:
            infos: infos by vehicle.
            departed: vehicle that has left the road in this step, by its slot.
        """
        waiting = len(self._without_slot())
        found: Infos = {}
        for slot, vehicle in self._vehicle_in.items():
            info: dict[str, Any] = {"action_mask": self._observer.only_hold()}
            if vehicle is not None:
                info |= infos[vehicle]
            info |= {
                "occupied": vehicle is not None,
                "vehicle": vehicle,
                "vehicles_without_slot": waiting,
            }
            if slot in departed:
                trip = infos[departed[slot]]
                info["left"] = {
                    "vehicle": departed[slot],
                    "at_destination": trip["at_destination"],
                    "travel_time_s": trip["travel_time_s"],
                }
            found[slot] = info
        return found
