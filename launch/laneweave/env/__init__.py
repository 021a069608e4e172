"""Multi-agent reinforcement learning on laneweave: a PettingZoo environment of vehicles.

    from laneweave.env import parallel_env

    env = parallel_env("scenarios/demo.toml")
    observations, infos = env.reset(seed=1)

See docs/ENVIRONMENT.md.
"""

from laneweave.env.factory import parallel_env
from laneweave.env.rewards import Rewards
from laneweave.env.slots_env import SlotsEnv
from laneweave.env.vehicles_env import VehiclesEnv

__all__ = ("Rewards", "SlotsEnv", "VehiclesEnv", "parallel_env")
