"""Which methods are run at which volumes, and what is asked of them."""

from __future__ import annotations

from typing import Final

from attrs import frozen

from laneweave.launch.option_values import KeepTrajectories
from laneweave.launch.sweep.methods import METHODS
from laneweave.launch.sweep.points import Point, plan_points
from laneweave.protocol.scenario import Scenario

SEEDS: Final = range(1, 6)
DURATION_S: Final = 600.0
"""Vehicles arrive for this long at each point."""
VOLUMES: Final = (1000.0, 1150.0, 1300.0, 1450.0, 1600.0, 1750.0, 2000.0, 2200.0, 2400.0)
"""In vehicles/(lane h): the paper's, and beyond them."""
PAPER_BOUND: Final = METHODS["paper-12"].settings(Scenario()).formation.bound_veh_per_lane_h
"""Most vehicles/(lane h) that interlaced formations can carry (the paper's V_u)."""


def _up_to(most_veh_per_lane_h: float) -> tuple[float, ...]:
    return tuple(volume for volume in VOLUMES if volume <= most_veh_per_lane_h)


WITHIN_BOUND: Final = _up_to(PAPER_BOUND)
ROLLING_VOLUMES: Final = tuple(sorted({*VOLUMES, PAPER_BOUND}))


@frozen
class Part:
    """Labels that are run at the same volumes."""

    labels: tuple[str, ...]
    volumes: tuple[float, ...]
    """In vehicles/(lane h)."""
    keep: KeepTrajectories


PARTS: Final = (
    Part(("rolling",), ROLLING_VOLUMES, KeepTrajectories.all),
    Part(("paper-6", "paper-12"), WITHIN_BOUND, KeepTrajectories.all),
    Part(("lc2013", "lc2013-4s"), VOLUMES, KeepTrajectories.first_seed),
    # Not far beyond their jams: those only grow, and cost more time than all the rest.
    Part(("rule", "rule-yielding"), _up_to(2200.0), KeepTrajectories.first_seed),
    Part(("rule-net",), _up_to(1600.0), KeepTrajectories.first_seed),
)
"""The dear ones first: short runs fill the gaps at the end."""
LABELS: Final = (
    "rolling", "paper-6", "paper-12", "rule", "rule-net", "rule-yielding", "lc2013", "lc2013-4s"
)  # fmt: skip
"""In the order of tables."""
FORMATIONS: Final = ("rolling", "paper-6", "paper-12")
"""Labels of formation control: these have promises to keep."""


def planned(label: str, volume_veh_per_lane_h: float) -> bool:
    """Tell whether a label is run at a volume."""
    return any(label in part.labels and volume_veh_per_lane_h in part.volumes for part in PARTS)


def points_of(base: Scenario, seed: int) -> tuple[Point, ...]:
    """Return all points of a seed, in the order in which they are run."""
    return tuple(
        point
        for part in PARTS
        for point in plan_points(base, part.labels, part.volumes[::-1], [seed], _keep(part, seed))
    )


def _keep(part: Part, seed: int) -> KeepTrajectories:
    if part.keep is KeepTrajectories.first_seed and seed != SEEDS[0]:
        return KeepTrajectories.none
    return part.keep


@frozen
class Goal:
    """What is asked at a volume; travel times are means over the seeds."""

    volume_veh_per_lane_h: float
    paper_s: float | None
    """Travel time of the paper's operation with at most 12 vehicles; None: nothing is asked."""
    rolling_s: float
    """Travel time of the rolling operation."""
    on_lane_percent: float
    """Share that leaves on its preferred lane, of either."""


GOALS: Final = (
    *(Goal(volume, 67.5, 66.8, 100.0) for volume in (1000.0, 1150.0, 1300.0, 1450.0)),
    Goal(1600.0, 69.5, 66.8, 100.0),
    Goal(1750.0, 73.0, 67.0, 100.0),
    Goal(PAPER_BOUND, None, 67.0, 100.0),
    Goal(2000.0, None, 67.5, 99.95),
    Goal(2200.0, None, 67.5, 99.95),
    Goal(2400.0, None, 68.0, 99.9),
)
LEAST_FACTORS: Final = {"zenoh": 2.0, "zenoh-50": 5.0, "simulated": 6.0}
"""Real-time factors asked for at 1600 vehicles/(lane h), by trial."""
MOST_COST_RATIO: Final = 1.2
"""A vehicle may cost so many times as much on the long road as on the short one."""
