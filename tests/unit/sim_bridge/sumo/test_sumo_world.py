"""SUMO shows every vehicle exactly where it was placed, and drives none."""

from __future__ import annotations

import ctypes
import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State
from laneweave.sim_bridge.bodies.overlaps_and_gaps import pose_of
from laneweave.sim_bridge.sumo import simulation as sumo
from laneweave.sim_bridge.sumo.simulation import SumoUnavailableError
from laneweave.sim_bridge.sumo.sumo_world import SumoWorld
from support.commands import loads

SCENARIO = Scenario()


@pytest.fixture
def world(tmp_path: Path) -> Iterator[SumoWorld]:
    with SumoWorld(SCENARIO, tmp_path / "sumo") as world:
        yield world


def cruising(s_m: float, y_m: float, v_y_mps: float = 0.0) -> State:
    return (s_m, 15.0, 0.0, y_m, v_y_mps, 0.0)


def add(world: SumoWorld, states: dict[str, State]) -> None:
    for vehicle, state in states.items():
        world.add(vehicle, state)
    world.step()


def assert_exact(world: SumoWorld, states: dict[str, State]) -> None:
    shown = world.positions()
    assert set(shown) == set(states)
    for vehicle, state in states.items():
        assert shown[vehicle] == pytest.approx(pose_of(state), abs=1e-6)


def test_the_whole_road_and_every_lateral_position_are_exact(world: SumoWorld) -> None:
    borders = [0.9, 1.75, 3.5, 3.5 - 1e-9, 3.5 + 1e-9, 5.25, 7.0, 8.75, 9.6]
    states = {f"v{n}": cruising(0.0, y) for n, y in enumerate(borders)}
    add(world, states)
    assert_exact(world, states)
    for s_m in [*np.arange(0.0, 1000.0, 7.3), 999.999, 1000.0, 1002.5, 1030.0]:
        for n, (vehicle, (_, _, _, y_m, _, _)) in enumerate(list(states.items())):
            v_y = 3.0 * math.sin(n + s_m / 50.0)
            states[vehicle] = (float(s_m), 15.0 + n % 3, -2.0, y_m, v_y, 0.0)
            world.place(vehicle, states[vehicle])
        world.step()
        assert_exact(world, states)


@pytest.mark.slow
def test_random_motion_and_traffic_are_exact(world: SumoWorld) -> None:
    rng = np.random.default_rng(1)
    states: dict[str, State] = {}
    number = 0
    for tick in range(600):
        if tick % 7 == 0:
            number += 1
            states[f"v{number}"] = cruising(0.0, rng.uniform(0.9, 9.6))
            world.add(f"v{number}", states[f"v{number}"])
        for vehicle, (s, v, _, y, _, _) in list(states.items()):
            if s > 1000.0:
                world.remove(vehicle)
                del states[vehicle]
                continue
            accel = float(rng.uniform(-10.0, 5.0))
            v_next = min(max(v + 0.1 * accel, 0.0), 25.0) if tick % 50 else 15.0
            y_next = min(max(y + float(rng.normal(0.0, 0.1)), 0.9), 9.6)
            v_y = float(rng.uniform(-0.25, 0.25)) * v_next
            states[vehicle] = (s + 0.05 * (v + v_next), v_next, accel, y_next, v_y, 0.0)
            world.place(vehicle, states[vehicle])
        world.step()
        assert_exact(world, states)
    assert number > 80


def test_a_vehicle_that_is_not_placed_stays(world: SumoWorld) -> None:
    world.add("v1", cruising(100.0, 1.75))
    for _ in range(5):
        world.step()
        assert world.positions()["v1"] == pytest.approx((100.0, 1.75, 0.0, 15.0), abs=1e-6)


def test_a_vehicle_is_shown_from_the_step_after_its_addition_to_its_removal(
    world: SumoWorld,
) -> None:
    for s_m in (10.0, 20.0):  # a name can be used again
        world.add("v1", cruising(s_m, 1.75))
        assert world.positions() == {}
        world.step()
        assert world.positions()["v1"][0] == pytest.approx(s_m)
        world.remove("v1")
        assert world.positions() == {}
        world.step()
    world.add("v1", cruising(10.0, 1.75))
    world.remove("v1")  # within one tick
    world.step()
    assert world.positions() == {}


def test_sumo_reports_a_collision_and_leaves_the_vehicles_where_they_are(world: SumoWorld) -> None:
    states = {"b": cruising(100.0, 1.75), "a": cruising(103.0, 1.75), "c": cruising(120.0, 1.75)}
    add(world, states)
    for _ in range(3):
        states = {v: (s + 1.5, *rest) for v, (s, *rest) in states.items()}  # type: ignore[misc]
        for vehicle, state in states.items():
            world.place(vehicle, state)
        world.step()
        assert world.collisions() == [("a", "b")]
        assert_exact(world, states)


@pytest.mark.parametrize(("length_m", "gap_m", "overlaps"), [(1.8, 2.0, False), (16.0, -5.0, True)])
def test_sumo_knows_the_sizes_of_vehicles_without_a_type(
    world: SumoWorld, length_m: float, gap_m: float, overlaps: bool
) -> None:
    for s_m, name in ((100.0, "other"), (100.0 - length_m - gap_m, "v1")):
        world.add(name, (s_m, 0.0, 0.0, 1.75, 0.0, 0.0))
    world.resize("other", (length_m, 1.8))
    for _ in range(2):
        world.step()
    assert (world.collisions() == [("other", "v1")]) is overlaps


def test_misuse_is_refused(world: SumoWorld, tmp_path: Path) -> None:
    world.add("v1", cruising(0.0, 1.75))
    with pytest.raises(ValueError, match="already on the road"):
        world.add("v1", cruising(0.0, 1.75))
    with pytest.raises(ValueError, match="not on the road"):
        world.place("v2", cruising(0.0, 1.75))
    with pytest.raises(ValueError, match="not on the road"):
        world.remove("v2")
    with pytest.raises(ValueError, match="s in"):
        world.place("v1", cruising(1031.0, 1.75))
    with pytest.raises(ValueError, match="finite"):
        world.place("v1", cruising(math.nan, 1.75))
    with pytest.raises(RuntimeError, match="one simulation per process"):
        SumoWorld(SCENARIO, tmp_path / "other")


def test_closing_twice_and_opening_again(tmp_path: Path) -> None:
    for number in range(3):
        world = SumoWorld(SCENARIO, tmp_path / str(number))
        world.add("v1", cruising(0.0, 1.75))
        world.step()
        world.close()
        world.close()


def test_odd_roads_are_exact(tmp_path: Path) -> None:
    scenario = parse_scenario(
        {"road": {"lanes": 5, "lane_width_m": 3.1, "s1_m": 0.0, "s2_m": 33.3, "s3_m": 777.7}}
    )
    with SumoWorld(scenario, tmp_path) as world:
        states = {
            f"v{lane}": cruising(160.0 * lane + 0.123, (lane + 0.5) * 3.1, 0.3) for lane in range(5)
        }
        add(world, states)
        assert_exact(world, states)


class Broken:
    """An import finder that fails as a missing shared library does."""

    def find_spec(self, name: str, *_: object) -> None:
        if name == "libsumo":
            raise ImportError("libX11.so.6: cannot open shared object file: No such file")


def test_a_missing_libsumo_error_names_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "libsumo", None)
    with pytest.raises(SumoUnavailableError, match=r"pip install 'laneweave\[sim\]'"):
        SumoWorld(SCENARIO, tmp_path)
    assert "LIBSUMO_AS_TRACI" not in os.environ


def test_missing_system_libraries_are_named_by_their_debian_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lacks_some(library: str) -> object:
        if library in ("libX11.so.6", "libatomic.so.1"):
            raise OSError(library)
        return object()

    monkeypatch.delitem(sys.modules, "libsumo", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Broken(), *sys.meta_path])
    monkeypatch.setattr(ctypes, "CDLL", lacks_some)
    with pytest.raises(SumoUnavailableError, match="apt-get install libx11-6 libatomic1 "):
        SumoWorld(SCENARIO, tmp_path)
    assert sumo.DEBIAN_PACKAGES.keys() >= {"libXext.so.6", "libXrender.so.1", "libGL.so.1"}


def test_nothing_but_a_world_imports_libsumo() -> None:
    assert not loads("laneweave.sim_bridge.sumo.sumo_world", "libsumo")
