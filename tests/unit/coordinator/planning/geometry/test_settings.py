"""Sizes and times of a geometry: errors name the inconsistent field."""

import math
from collections.abc import Mapping
from itertools import product
from typing import Any

import attrs
import numpy as np
import pytest

from laneweave.coordinator.planning.geometry.swept_bodies import BodyGeometry
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.launch.bench.request_families import formation_request
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from oracles.moving_bodies import Bodies, motion
from support.tables import for_each


def test_defaults_are_those_of_the_default_scenario() -> None:
    geometry, scenario = BodyGeometry(), Scenario()
    assert geometry.length_m == scenario.vehicle.length_m
    assert geometry.width_m == scenario.vehicle.width_m
    assert geometry.lane_width_m == scenario.road.lane_width_m
    assert geometry.pitch_m == scenario.formation.gap_m
    assert geometry.move_s == scenario.timing.move_s
    assert geometry.slot_s == scenario.timing.cycles_s[0]
    assert geometry.speed_mps == scenario.formation.speed_mps
    assert geometry.clearance_along_m > scenario.tracking.min_gap_m


def test_defaults_are_those_of_the_oracle() -> None:
    assert geometry_of(Bodies()) == BodyGeometry()


def geometry_from(fields: Mapping[str, object]) -> BodyGeometry | None:
    document = {**formation_request(0, mode=2).to_dict(), "geometry": fields}
    return PlanRequest.from_dict(document).geometry


def geometry_of(bodies: Bodies) -> BodyGeometry:
    return BodyGeometry(**vars(bodies))


@pytest.mark.parametrize("displacement", [(1, 0), (-1, 1), (0, -1), (0, 0)])
def test_the_default_profile_is_the_quintic(displacement: tuple[int, int]) -> None:
    path = BodyGeometry().paths()[displacement]
    places, _ = motion(Bodies(), displacement, np.linspace(0.0, 3.8, len(path)))
    assert np.allclose(path, places, atol=1e-12)


NAMES = [attribute.name for attribute in attrs.fields(BodyGeometry)]
WRONG: list[tuple[str, object]] = [
    *product(NAMES, ("1", True, [], math.nan, math.inf, -1, -0.001, 10**400, 1000.0)),
    *((name, None) for name in NAMES if name != "lateness_s"),
    ("length_m", 0.9),
    ("width_m", 0.4),
    ("lane_width_m", 1.9),
    ("move_s", 0.0),
    ("slot_s", 0.4),
    ("speed_mps", 0.0),
    ("colour", 1),
]


@for_each(("name", "value"), WRONG)
def test_errors_name_the_field(name: str, value: object) -> None:
    with pytest.raises(BadInputError) as caught:
        geometry_from({name: value})
    assert caught.value.field == f"geometry.{name}"
    assert "allowed: " in str(caught.value)
    assert "\n" not in str(caught.value)


UNFIT: list[tuple[str, Mapping[str, float]]] = [
    ("pitch_m", {"pitch_m": 5.0}),
    ("pitch_m", {"length_m": 15.0}),
    ("lane_width_m", {"lane_width_m": 2.0, "width_m": 2.0}),
    ("pitch_m", {"pitch_m": 5.2, "clearance_along_m": 0.0}),
    ("lane_width_m", {"width_m": 3.49}),
    ("slot_s", {"slot_s": 3.7}),
    ("slot_s", {"move_s": 4.1}),
    ("speed_mps", {"speed_mps": 7.4}),
    ("speed_mps", {"move_s": 1.8}),
    ("clearance_along_m", {"clearance_along_m": 9.2}),
    ("clearance_along_m", {"length_m": 9.5}),
    ("clearance_along_m", {"profile_error_along_m": 5.0}),
    ("clearance_across_m", {"clearance_across_m": 1.6}),
    ("clearance_across_m", {"lane_width_m": 2.2}),
    ("clearance_across_m", {"profile_error_across_m": 1.5}),
    ("lateness_s", {"lateness_s": 1.63}),
    ("lateness_s", {"lateness_s": 1.6, "slot_s": 3.8}),
    ("lateness_s", {"lateness_s": 1.2, "clearance_along_m": 9.0}),
]


@for_each(("name", "fields"), UNFIT)
def test_errors_name_inconsistent_fields(name: str, fields: dict[str, float]) -> None:
    with pytest.raises(BadInputError) as caught:
        geometry_from(fields)
    assert caught.value.field == f"geometry.{name}"


@pytest.mark.parametrize(
    "fields",
    [
        {"clearance_along_m": 9.19},
        {"clearance_across_m": 1.57},
        {"lateness_s": 1.62},
        {"lateness_s": 1.82, "slot_s": 4.2},
        {"speed_mps": 7.5, "clearance_across_m": 0.14},
        {"clearance_along_m": 0, "clearance_across_m": 0, "lateness_s": 0},
    ],
)
def test_limits_are_accepted(fields: dict[str, float]) -> None:
    geometry_from(fields)


@pytest.mark.parametrize(
    ("name", "value"),
    [("clearance_along_m", 100.0), ("clearance_across_m", 9.0), ("lateness_s", 3.0)],
)
def test_the_allowed_value_in_an_error_is_accepted(name: str, value: float) -> None:
    with pytest.raises(BadInputError) as caught:
        geometry_from({name: value})
    limit = float(caught.value.allowed.removeprefix("at most ").partition(":")[0].split(",")[0])
    assert attrs.evolve(BodyGeometry(), **{name: limit})
    with pytest.raises(BadInputError):
        attrs.evolve(BodyGeometry(), **{name: limit + 0.04})


@pytest.mark.parametrize("value", [None, [], 5, "geometry"])
def test_a_geometry_is_an_object(value: object) -> None:
    document = {**formation_request(0, mode=2).to_dict(), "geometry": value}
    with pytest.raises(BadInputError) as caught:
        PlanRequest.from_dict(document)
    assert caught.value.field == "geometry"


def test_a_geometry_needs_geometric() -> None:
    document: dict[str, Any] = formation_request(0, mode=1).to_dict()
    with pytest.raises(BadInputError) as caught:
        PlanRequest.from_dict({**document, "geometry": {}})
    assert caught.value.field == "geometry"
    assert "geometric" in caught.value.allowed
    chosen = PlanRequest.from_dict({**document, "geometry": {}, "conflicts": ["geometric"]})
    assert chosen.geometry == BodyGeometry()


def test_without_a_geometry_nothing_is_written() -> None:
    document = formation_request(0, mode=2).to_dict()
    assert "geometry" not in document
    written = PlanRequest.from_dict({**document, "geometry": {"lateness_s": 0.5}}).to_dict()
    assert written["geometry"]["lateness_s"] == 0.5
    assert PlanRequest.from_dict(written).geometry == BodyGeometry(lateness_s=0.5)
