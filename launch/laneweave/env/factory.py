"""The function that makes environments."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np

from laneweave.env.rewards import Rewards
from laneweave.env.slots_env import SlotsEnv
from laneweave.env.vehicles_env import VehiclesEnv
from laneweave.protocol.config.scenario_files import load_scenario, scenario_of, to_tables
from laneweave.protocol.errors import BadInputError, unknown_name
from laneweave.protocol.scenario.fields import Scenario

ROLLING: Final[Mapping[str, Any]] = {
    "formation__operation": "rolling",
    "runtime__coordinators": 1,
}
"""Values of the scenario that the environment sets."""
MAX_COLUMNS, MAX_SLOTS = 20, 10_000
Agents = Literal["vehicles", "slots"]


def parallel_env(
    scenario: Scenario | Path | str | Mapping[str, Any] | None = None,
    *,
    rewards: Rewards | None = None,
    columns: int = 3,
    vary_demand: bool = False,
    agents: Agents = "vehicles",
    slots: int | None = None,
    render_mode: str | None = None,
) -> VehiclesEnv:
    """Return a PettingZoo `ParallelEnv` in which the agents are vehicles, or slots for them.

    Args:
        scenario: a scenario, its file or its tables; None: the paper's road. The environment runs
            it with the rolling operation and one coordinator.
        rewards: weights of the reward; None: the defaults.
        columns: number of columns of cells that a vehicle observes ahead, and behind; 1 to 20.
        vary_demand: whether each episode draws its own vehicles. False: every episode has the
            vehicles of the scenario's seed, and the seed of `reset` changes the rest: measurement
            errors and the delays of messages.
        agents: `vehicles`: an agent is a vehicle, from its entry until it leaves. `slots`: a fixed
            number of agents, each of which drives one vehicle after another (`SlotsEnv`).
        slots: number of slots, 1 to 10000; None: as many as vehicles. Only for `agents="slots"`.
        render_mode: `rgb_array`: `render` returns pictures; None: it returns None.

    Raises:
        BadInputError: the scenario or a value is invalid; the scenario has a SUMO simulation.
    """
    if not _is_integer(columns) or not 1 <= columns <= MAX_COLUMNS:
        raise BadInputError("columns", columns, f"an integer from 1 to {MAX_COLUMNS}")
    if agents not in get_args(Agents):
        raise unknown_name("agents", agents, get_args(Agents))
    if slots is not None and agents != "slots":
        raise BadInputError("slots", slots, 'None, unless agents="slots"')
    if slots is not None and not (_is_integer(slots) and 1 <= slots <= MAX_SLOTS):
        raise BadInputError("slots", slots, f"an integer from 1 to {MAX_SLOTS}, or None")
    modes = VehiclesEnv.metadata["render_modes"]
    if render_mode is not None and render_mode not in modes:
        raise unknown_name("render_mode", render_mode, modes)
    if isinstance(scenario, Scenario):
        settings = scenario_of(to_tables(scenario), **ROLLING)
    elif isinstance(scenario, Mapping):
        settings = scenario_of(scenario, **ROLLING)
    else:
        settings = load_scenario(None if scenario is None else Path(scenario), **ROLLING)
    if settings.sumo.config:
        raise BadInputError("sumo.config", settings.sumo.config, "none: there is no SUMO here")
    if settings.radio.enabled:
        technology = settings.radio.technology
        raise BadInputError("radio.technology", technology, "none: nothing is lost here")
    given: dict[str, Any] = {"vary_demand": vary_demand, "render_mode": render_mode}
    if agents == "slots":
        return SlotsEnv(settings, rewards or Rewards(), columns, slots=slots, **given)
    return VehiclesEnv(settings, rewards or Rewards(), columns, **given)


def _is_integer(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)
