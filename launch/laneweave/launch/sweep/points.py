"""The points of a sweep, each of which is a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from attrs import evolve, frozen

from laneweave.agents.driving.trajectory import check_moves
from laneweave.coordinator.planning.plug_ins.registry import check_solver
from laneweave.launch.run_methods import (
    FORMATION,
    REFERENCE_METHODS,
    SUMO_HAS_DEMAND,
    KeepTrajectories,
    LabelledMethod,
    labelled,
    reference_method,
)
from laneweave.protocol.config.scenario_files import parse_scenario, to_tables
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario

MAX_POINTS = 100_000


@frozen
class Point:
    """One run of a sweep."""

    label: str
    method: str
    scenario: Scenario
    keep_trajectories: bool

    @property
    def volume_veh_per_lane_h(self) -> float:
        """Demand per lane."""
        return self.scenario.demand.volume_veh_per_lane_h

    @property
    def name(self) -> str:
        """Name of the point's folder."""
        return f"{self.label}-{volume_text(self.volume_veh_per_lane_h)}-{self.scenario.seed}"


def volume_text(volume_veh_per_lane_h: float) -> str:
    """Return a volume as text for use in names."""
    return f"{volume_veh_per_lane_h:.10g}"


def sweep_volumes(text: str | None, base: Scenario, default: str = "") -> tuple[float, ...]:
    """Return the volumes of a comma-separated list, in vehicles/(lane h).

    A corridor of a SUMO simulation has the demand of that simulation, and so one volume.

    Raises:
        BadInputError: a volume is not a number, impossible in this scenario, or repeated.
    """
    if base.sumo.config:
        if text is not None:
            raise BadInputError("--volumes", text, SUMO_HAS_DEMAND)
        return (base.demand.volume_veh_per_lane_h,)
    volumes: list[float] = []
    text = default if text is None else text
    for entry in text.split(","):
        try:
            volume = float(entry)
        except ValueError:
            raise BadInputError("--volumes", entry, "comma-separated numbers") from None
        try:
            with_volume(base, volume)
        except BadInputError as error:
            raise BadInputError("--volumes", entry, error.allowed) from error
        if volume_text(volume) in map(volume_text, volumes):
            raise BadInputError("--volumes", text, f"{volume_text(volume)} only once")
        volumes.append(volume)
    return tuple(volumes)


def plan_points(
    base: Scenario,
    labels: Sequence[str],
    volumes: Sequence[float],
    seeds: Sequence[int],
    keep: KeepTrajectories,
) -> tuple[Point, ...]:
    """Return the points of labels; see `points_of`."""
    return points_of(base, {label: labelled(label) for label in labels}, volumes, seeds, keep)


def points_of(
    base: Scenario,
    methods: Mapping[str, LabelledMethod],
    volumes: Sequence[float],
    seeds: Sequence[int],
    keep: KeepTrajectories,
) -> tuple[Point, ...]:
    """Return all points of methods by label, in the order of execution: seed by seed.

    Raises:
        BadInputError: there are too many points, or settings of a method contradict the scenario.
    """
    count = len(methods) * len(volumes) * len(seeds)
    if count > MAX_POINTS:
        raise BadInputError("--seeds", len(seeds), f"at most {MAX_POINTS} runs, not {count}")
    settings: list[tuple[str, LabelledMethod, Scenario]] = []
    for label, method in methods.items():
        for volume in volumes:
            try:
                # A method may have a volume of its own.
                scenario = checked_settings(method, with_volume(base, volume))
            except BadInputError as error:
                field = f"{error.field} ({label})"
                raise BadInputError(field, error.value, error.allowed) from error
            settings.append((label, method, scenario))
    kept = {
        KeepTrajectories.none: (),
        KeepTrajectories.first_seed: seeds[:1],
        KeepTrajectories.all: seeds,
    }[keep]
    return tuple(
        Point(label, method.method, evolve(scenario, seed=seed), seed in kept)
        for seed in seeds
        for label, method, scenario in settings
    )


def checked_settings(method: LabelledMethod, base: Scenario) -> Scenario:
    """Return the scenario of a method, in which its vehicles can drive.

    Raises:
        BadInputError: settings contradict the scenario, moves are impossible, or a plug-in is
            missing or does not support the scenario.
    """
    scenario = method.settings(base)
    if method.method == FORMATION:
        check_moves(scenario)
    _check_plug_ins(scenario, method.method)
    return scenario


def _check_plug_ins(scenario: Scenario, method: str) -> None:
    """Check that the plug-in of a method or planner exists, and supports the scenario.

    Raises:
        BadInputError: it does not.
    """
    if scenario.sumo.config and method != FORMATION:
        raise BadInputError("--methods", method, f"{FORMATION}, with a SUMO simulation")
    if method == FORMATION:
        check_solver(scenario.formation.solver, "formation.solver")
    elif not REFERENCE_METHODS.is_built_in(method):
        reference_method(method, "--methods").check(scenario)


def with_volume(scenario: Scenario, volume_veh_per_lane_h: float) -> Scenario:
    """Return the scenario with another volume.

    Raises:
        BadInputError: the volume is impossible in this scenario.
    """
    tables = to_tables(scenario)
    tables["demand"]["volume_veh_per_lane_h"] = volume_veh_per_lane_h
    return parse_scenario(tables)
