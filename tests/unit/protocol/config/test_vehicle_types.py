"""Types of vehicles: what each inherits, which moves it drives, and what is refused."""

from __future__ import annotations

from typing import Any

import attrs
import pytest

from laneweave.agents.driving.trajectory import check_moves, move_profile
from laneweave.protocol.config.motion_checks import min_pitch_m
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import displacements
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_types import VehicleType
from laneweave.protocol.vehicle.re_entry import own_re_entry, re_entry
from support.refusals import refusal
from support.tables import for_each
from support.variants import variants

ROLLING = {"operation": "rolling", "gap_m": 20.0}
TRUCK: dict[str, Any] = {
    "name": "truck",
    "share": 0.15,
    "length_m": 12.0,
    "width_m": 2.5,
    "max_accel_mps2": 1.3,
    "min_accel_mps2": -7.0,
}
VAN = {"name": "van", "share": 0.2, "length_m": 7.0, "max_accel_mps2": 3.5}
STRUCTURES = {
    "cycle_s": 6.0,
    "gap_m": 18.0,
    "structures": [{"from_m": 200.0, "structure": "interlaced"}],
}
SPORTS_CAR = {"name": "sports-car", "share": 0.1, "max_accel_mps2": 9.0}


def scenario(*types: dict[str, Any], **tables: Any) -> Scenario:  # noqa: ANN401 (tables)
    return parse_scenario({"formation": ROLLING, "vehicle_type": list(types), **tables})


def test_without_other_types_all_vehicles_are_cars() -> None:
    only = Scenario()
    every = frozenset(displacements(1)[1:])
    assert dict(only.types) == {"car": VehicleType("car", only.vehicle, every)}


def test_a_type_has_the_limits_of_cars_except_its_own() -> None:
    cars = {"max_slip_ratio": 0.2, "max_jerk_mps3": 12.0}
    found = scenario(TRUCK, SPORTS_CAR, vehicle=cars)
    assert list(found.types) == ["car", "truck", "sports-car"]
    truck = found.types["truck"].limits
    own = {name: value for name, value in TRUCK.items() if name not in ("name", "share")}
    assert truck == attrs.evolve(found.vehicle, **own)
    assert found.types["sports-car"].limits == attrs.evolve(found.vehicle, max_accel_mps2=9.0)
    assert found.types["car"].limits == found.vehicle
    assert (found.types.longest_body_m, found.types.widest_body_m) == (12.0, 2.5)


def test_what_concerns_all_types_suits_the_longest_and_weakest() -> None:
    # On this road, T_F follows from the ramp and from what cars can drive.
    found = scenario(
        TRUCK,
        SPORTS_CAR,
        road={
            "s1_m": 50.0,
            "s2_m": 50.0,
            "s3_m": 600.0,
            "closures": [{"lane": 0, "to_m": 50.0}, {"lane": 0, "from_m": 550.0}],
        },
        entrance=[
            {"name": "on", "lane": 0, "at_m": 50.0, "merge_m": 250.0, "volume_veh_per_h": 300.0}
        ],
    )
    assert found.timing.cycles_s == pytest.approx((5.2, 5.2))
    needed = [own_re_entry(found, one.limits) for one in found.types.values()]
    for name in ("room_m", "columns", "distance_m"):
        assert getattr(re_entry(found), name) == max(getattr(one, name) for one in needed)
    assert len(set(needed)) > 1
    assert found.types.longest_body_m == 12.0


@pytest.mark.parametrize(
    ("limits", "all_moves"),
    [
        ({"max_accel_mps2": 3.5}, True),
        ({"max_accel_mps2": 3.4}, False),
        ({"min_accel_mps2": -3.4}, False),
        ({"max_jerk_mps3": 6.1}, False),
        ({"length_m": 8.0}, True),
        ({"max_accel_mps2": 6.0}, True),
    ],
)
def test_a_type_changes_columns_if_its_limits_allow(
    limits: dict[str, float], *, all_moves: bool
) -> None:
    # 20 m in 5.8 s need 3.43 m/s2 and 6.15 m/s3.
    found = scenario({"name": "other", "share": 0.1, **limits}, braking={"lead_brake_mps2": 3.0})
    lateral = frozenset({(0, 1), (0, -1)})
    every = frozenset(displacements(1)[1:])
    assert found.types["other"].moves == (every if all_moves else lateral)
    assert found.types["car"].moves == every


@pytest.mark.parametrize(
    "limits", [{"length_m": 5.5}, {"max_lateral_accel_mps2": 2.9}, {"max_accel_mps2": 6.0}]
)
def test_types_as_strong_as_cars_drive_all_moves(limits: dict[str, float]) -> None:
    """Minimum-jerk moves over 15 m in 3.8 s need 6 m/s2; the trajectory of a car needs less."""
    structures = [{"from_m": 200.0, "structure": "interlaced"}]
    types = [{"name": "other", "share": 0.1, **limits}]
    found = parse_scenario({"vehicle_type": types, "formation": {"structures": structures}})
    assert found.vehicle.max_accel_mps2 == 5.0
    assert found.types.moves_of("other") is None


def test_the_moves_that_are_planned_for_a_type_can_be_driven() -> None:
    found = scenario(TRUCK)
    check_moves(found)
    truck = found.types["truck"]
    for dx, dy in truck.moves:
        states = move_profile(found, truck.limits, dx, dy).states
        assert abs(states[:, 5]).max() <= truck.limits.max_lateral_accel_mps2
    weak = scenario({**TRUCK, "max_lateral_accel_mps2": 0.3})
    with pytest.raises(BadInputError, match=r"a move of a truck by 1 lane .*lateral limits"):
        check_moves(weak)


def test_moves_of_types() -> None:
    found = scenario(TRUCK, VAN)
    moves = [found.types.moves_of(name) for name in ("car", "truck", "van", "bus")]
    assert moves == [None, frozenset({(0, 1), (0, -1)}), None, frozenset()]


@pytest.mark.parametrize(
    ("tables", "shortest_s"),
    variants(
        [
            ({"formation": {"gap_m": 20.0}, "vehicle_type": [TRUCK]}, 5.0),
            ({}, 4.0),
            ({"formation": {"gap_m": 16.0, "speed_mps": 12.0}}, 4.0),
            ({"vehicle": {"max_accel_mps2": 3.0}}, 5.0),
        ]
    ),
)
def test_formations_have_longer_slots_only_where_moves_need_them(
    tables: dict[str, Any], shortest_s: float
) -> None:
    found = parse_scenario(tables)
    assert found.timing.cycles_s == pytest.approx((shortest_s, 7.0))
    check_moves(found)


def test_the_pitch_suits_every_pair_of_types() -> None:
    found = scenario(TRUCK)
    needed = {name: min_pitch_m(found, own.limits) for name, own in found.types.items()}
    # A truck brakes less than the vehicle ahead may.
    assert needed["truck"] > needed["car"] + 3.0
    # Behind a truck, a car needs the length of its body more.
    assert needed["car"] == pytest.approx(
        min_pitch_m(Scenario(), Scenario().vehicle) + 7.0, abs=0.01
    )


@for_each(("types", "tables", "line"), [
    ([{**TRUCK, "name": "car"}], {}, "vehicle_type[0].name: got 'car'"),
    ([TRUCK, TRUCK], {}, "vehicle_type[1].name: got 'truck'"),
    ([TRUCK, {**SPORTS_CAR, "share": 0.9}], {}, "vehicle_type.share: got [0.15, 0.9]"),
    ([{**TRUCK, "share": 1.5}], {}, "vehicle_type[0].share: got 1.5"),
    ([{**TRUCK, "length_m": 60.0}], {}, "vehicle_type[0].length_m: got 60.0"),
    ([{**TRUCK, "wheels": 6}], {}, "vehicle_type[0].wheels"),
    ([{"share": 0.1}], {}, "vehicle_type[0].name"),
    ([TRUCK], {"formation": {**STRUCTURES, "gap_m": 20.0}},
     "vehicle_type[0].max_accel_mps2: got 1.3; allowed: at least 3.44 with formation."),
    ([{**VAN, "min_accel_mps2": -3.0}],
     {"formation": STRUCTURES, "braking": {"lead_brake_mps2": 3.0}},
     "vehicle_type[0].min_accel_mps2: got -3.0; allowed: at most -3.09 with formation."),
    ([{**VAN, "max_jerk_mps3": 5.0}], {"formation": STRUCTURES},
     "vehicle_type[0].max_jerk_mps3: got 5.0; allowed: at least 5.54 with formation."),
    ([TRUCK], {"formation": {**ROLLING, "gap_m": 18.0}},
     "formation.gap_m: got 18.0; allowed: at least 19.338"),
    ([{**TRUCK, "width_m": 3.2}], {}, "road.lane_width_m: got 3.5; allowed: at least 3.7"),
    ([{**TRUCK, "max_accel_mps2": 0.1}], {"road": {"closures": [{"lane": 0, "from_m": 900.0}]}},
     "vehicle_type[0].max_accel_mps2: got 0.1; allowed: more"),
    ([{**TRUCK, "min_accel_mps2": -10.5}], {},
     "vehicle_type[0].min_accel_mps2: got -10.5; allowed: at least -10: "),
    ([{**SPORTS_CAR, "max_jerk_mps3": 0.4}], {"formation": {**ROLLING, "cycle_s": 16.0}},
     "formation.settle_s: got 10.0"),
])  # fmt: skip
def test_types_that_do_not_fit_are_refused_in_one_line(
    types: list[dict[str, Any]], tables: dict[str, Any], line: str
) -> None:
    assert str(refusal(scenario, *types, **tables)).startswith(line)
