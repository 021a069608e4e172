"""One episode of the PettingZoo environment: each vehicle requests moves towards its lane.

python examples/pettingzoo_env.py [SCENARIO.toml]
"""

import sys

import numpy as np

from laneweave.env import parallel_env
from laneweave.env.observations import OWN

env = parallel_env(sys.argv[1] if len(sys.argv) > 1 else None)
to_target, refused = OWN.index("to_target"), OWN.index("refused")
random, total = np.random.default_rng(1), 0.0
observations, infos = env.reset(seed=1)
while env.agents:
    actions = {}
    for name in env.agents:
        own, mask = observations[name], infos[name]["action_mask"]
        action = env.moves.index((0, int(np.sign(own[to_target]))))
        if not mask[action] or (own[refused] and random.random() < 0.5):
            action = random.choice(np.flatnonzero(mask))  # make room, or try elsewhere
        actions[name] = int(action)
    observations, rewards, terminations, truncations, infos = env.step(actions)
    total += sum(rewards.values())
trips = env.record.trips.values()
print(f"{sum(trip.at_destination for trip in trips)} of {len(trips)} vehicles in their lanes")
print(f"total reward {total:.2f}; overlaps: {len(env.record.overlaps)}")
