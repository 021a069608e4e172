"""Surprises on the road, drawn at random (at the real roadside).

Vehicles break down, parts of lanes are closed for a time, and slow and fast vehicles of other
systems pass. All are over before the faults are.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from attrs import frozen

from laneweave.protocol.scenario.road_tables import RoadEvent
from laneweave.sim_bridge.road.obstacles import Breakdown

KINDS = ("breakdown", "breakdown", "closed", "closed", "slow", "fast")
"""Kinds to draw from."""
FROM_M = (140.0, 320.0)
"""Range of the positions at which parts begin: vehicles that enter can see them in time."""
PART_M, OTHER_M = (5.0, 80.0), (4.0, 12.0)
"""Ranges of the lengths of closed parts, and of vehicles of other systems."""
AT_S, FOR_S = (2.0, 20.0), (2.0, 15.0)
"""Ranges of the times at which surprises begin, and of how long they last."""
CLEAR_S = (0.0, 0.0, 5.0)
SLOW_MPS, FAST_MPS = (2.0, 13.0), (16.0, 30.0)
DECEL_MPS2 = (2.0, 8.0)


@frozen
class Surprises:
    """The surprises of a run."""

    events: tuple[RoadEvent, ...] = ()
    breakdowns: tuple[Breakdown, ...] = ()


NO_SURPRISES = Surprises()


def draw_surprises(count: int, lanes: Sequence[int], rng: random.Random) -> Surprises:
    """Draw surprises.

    Args:
        count: number of surprises.
        lanes: lanes that are open from end to end.
        rng: source of all draws.
    """
    events, breakdowns = list[RoadEvent](), list[Breakdown]()
    for _ in range(count):
        kind, lane = rng.choice(KINDS), rng.choice(lanes)
        at_s, for_s = rng.uniform(*AT_S), rng.uniform(*FOR_S)
        if kind == "breakdown":
            decel_mps2 = rng.uniform(*DECEL_MPS2)
            breakdowns.append(
                Breakdown(at_s, draw=rng.random(), decel_mps2=decel_mps2, for_s=for_s)
            )
            continue
        from_m = 0.0 if kind == "fast" else round(rng.uniform(*FROM_M), 1)
        length_m = rng.uniform(*(PART_M if kind == "closed" else OTHER_M))
        speeds = {"closed": (0.0, 0.0), "slow": SLOW_MPS, "fast": FAST_MPS}[kind]
        events.append(
            RoadEvent(
                lane=lane,
                from_m=from_m,
                to_m=round(from_m + length_m, 1),
                at_s=round(at_s, 1),
                for_s=round(for_s, 1),
                speed_mps=round(rng.uniform(*speeds), 1),
                clear_s=rng.choice(CLEAR_S),
            )
        )
    return Surprises(tuple(events), tuple(breakdowns))
