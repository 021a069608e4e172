"""One episode of the PettingZoo environment, in which each vehicle moves towards its lane.

python examples/pettingzoo_env.py [SCENARIO.toml] [SEED]
"""

import sys

import numpy as np

from laneweave.env import parallel_env
from laneweave.env.observations import OWN

TO_TARGET, REFUSED = OWN.index("to_target"), OWN.index("refused")


def choose(env, observation, mask, random):
    """Return the move towards the target lane; if it was refused, sometimes another move."""
    wanted = (0, int(np.sign(observation[TO_TARGET])))
    action = env.moves.index(wanted)
    if mask[action] and not (observation[REFUSED] and random.random() < 0.5):
        return action
    return int(random.choice(np.flatnonzero(mask)))


env = parallel_env(sys.argv[1] if len(sys.argv) > 1 else None)
seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
random, total = np.random.default_rng(seed), 0.0
observations, infos = env.reset(seed=seed)
while env.agents:
    actions = {
        name: choose(env, observations[name], infos[name]["action_mask"], random)
        for name in env.agents
    }
    observations, rewards, terminations, truncations, infos = env.step(actions)
    total += sum(rewards.values())
left = sum(trip.at_destination for trip in env.record.trips.values())
print(f"{left} of {len(env.record.trips)} vehicles left in their lanes, after {env.t_s:.1f} s")
print(f"total reward {total:.2f}, overlaps {len(env.record.overlaps)}")
