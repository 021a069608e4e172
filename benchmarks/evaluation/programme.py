"""Methods and volumes of the evaluation, and their goals."""

from __future__ import annotations

from typing import Final

from attrs import frozen

from laneweave.launch.run_methods import KeepTrajectories
from laneweave.launch.sweep.points import Point, plan_points
from laneweave.protocol.scenario.fields import Scenario

SEEDS: Final = range(1, 21)
DURATION_S: Final = 600.0
"""Duration of the arrivals at each point."""
VOLUMES: Final = (
    500.0, 750.0, 1000.0, 1150.0, 1300.0, 1450.0, 1600.0, 1750.0, 1800.0, 2000.0, 2200.0, 2400.0
)  # fmt: skip
"""In vehicles/(lane h): those of the paper, lower and higher ones."""


def paper_bound(speed_mps: float, pitch_m: float) -> float:
    """Return the capacity of interlaced formations in vehicles/(lane h) (the paper's V_u).

    Args:
        speed_mps: v_F.
        pitch_m: d_F.
    """
    return 3600.0 * speed_mps / (2.0 * pitch_m)


def _up_to(max_veh_per_lane_h: float) -> tuple[float, ...]:
    return tuple(volume for volume in VOLUMES if volume <= max_veh_per_lane_h)


@frozen
class Part:
    """Labels that are run at the same volumes."""

    labels: tuple[str, ...]
    volumes: tuple[float, ...]
    """In vehicles/(lane h)."""
    keep: KeepTrajectories


PARTS: Final = (
    Part(("rolling",), VOLUMES, KeepTrajectories.all),
    Part(("formations",), _up_to(2000.0), KeepTrajectories.all),
    Part(("paper-6", "paper-12"), _up_to(1800.0), KeepTrajectories.all),
    # More than the paper's bound, to see that no more is carried.
    Part(("paper-12",), (2000.0,), KeepTrajectories.all),
    # Jams only grow with the volume, and take longer to simulate than everything else.
    Part(("rule", "rule-yielding"), _up_to(1800.0), KeepTrajectories.first_seed),
    Part(("rule-net",), _up_to(1600.0), KeepTrajectories.first_seed),
    Part(("lc2013", "lc2013-4s"), _up_to(1800.0), KeepTrajectories.first_seed),
    Part(("lc2013-tuned", "sl2015-tuned"), VOLUMES, KeepTrajectories.first_seed),
)
"""Longest runs first, so that short ones fill the idle cores at the end."""
LABELS: Final = (
    "formations", "paper-6", "paper-12", "rolling",
    "rule", "rule-net", "rule-yielding", "lc2013", "lc2013-4s",
    "lc2013-tuned", "sl2015-tuned",
)  # fmt: skip
"""In the order of tables."""
FORMATIONS: Final = ("formations", "paper-6", "paper-12", "rolling")
"""Labels of formation control, whose runs must keep the guarantees."""


def planned(label: str, volume_veh_per_lane_h: float) -> bool:
    """Return whether a label is run at a volume."""
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
    """Requirements on a label at a volume; travel times are means over the seeds."""

    label: str
    volume_veh_per_lane_h: float
    travel_s: float
    """Maximum travel time."""
    on_lane_percent: float = 100.0
    """Minimum share of vehicles that leave in their preferred lane."""
    accel_mps2: float | None = None
    """Maximum acceleration and braking; None: no requirement beyond the vehicles' limits."""
    fallback_percent: float | None = None
    """Maximum share of plans by the fallback solver; None: no requirement."""


GOALS: Final = (
    Goal("formations", 1000.0, 66.7, fallback_percent=1.0),
    Goal("formations", 1600.0, 66.9, accel_mps2=3.5, fallback_percent=1.0),
    Goal("formations", 1750.0, 67.0, fallback_percent=2.0),
    Goal("formations", 2000.0, 67.5, fallback_percent=5.0),
    *(Goal("paper-12", volume, 67.5) for volume in (1000.0, 1150.0, 1300.0, 1450.0)),
    Goal("paper-12", 1600.0, 69.5),
    Goal("paper-12", 1750.0, 73.0),
    *(
        Goal("rolling", volume, 66.8, accel_mps2=3.0)
        for volume in (1000.0, 1150.0, 1300.0, 1450.0, 1600.0)
    ),
    *(Goal("rolling", volume, 67.0, accel_mps2=3.0) for volume in (1750.0, 1800.0, 2000.0)),
    Goal("rolling", 2200.0, 67.0, 99.95),
    Goal("rolling", 2400.0, 67.0, 99.9),
)


@frozen
class TunedFigure:
    """A figure that is compared with that of tuned drivers."""

    field: str
    """Name of a field of `RunRow`."""
    name: str
    """The figure in words."""
    unit: str
    requirement: str = ""
    """The maximum difference in words; empty: no requirement."""
    max_percent: float | None = None
    """Maximum difference, relative to the mean of the tuned drivers [%]; None: no requirement."""


TUNED_FIGURES: Final = (
    TunedFigure("travel_s", "travel time", "s", "at most 0.5 % longer", 0.5),
    TunedFigure("co2_g_per_km", "CO2", "g/km", "not higher", 0.0),
    TunedFigure("uncomfortable_percent", "time beyond comfort", "percentage points"),
)
MIN_FACTORS: Final = {"zenoh": 2.0, "zenoh-50": 5.0, "simulated": 6.0}
"""Minimum real-time factors at 1600 vehicles/(lane h), by trial."""
MAX_COST_RATIO: Final = 1.2
"""Maximum cost of a vehicle on the long road relative to the short one."""
