"""The world without SUMO shows bodies where they are placed."""

from __future__ import annotations

import pytest

from laneweave.sim_bridge.bodies.bodies_world import BodiesWorld
from laneweave.sim_bridge.bodies.overlaps_and_gaps import pose_of

HERE = (10.0, 15.0, 0.0, 1.75, 0.0, 0.0)
THERE = (11.5, 15.0, 0.0, 1.85, 0.5, 0.0)


def test_bodies_are_where_they_are_placed() -> None:
    world = BodiesWorld()
    world.add("a", HERE)
    world.add("b", HERE, "truck")
    world.place("a", THERE)
    world.step()
    assert world.positions() == {"a": pose_of(THERE), "b": pose_of(HERE)}
    world.remove("a")
    assert [*world.positions()] == ["b"]
    assert world.collisions() == []
    assert [*world.others()] == []


def test_vehicles_must_be_on_the_road_once() -> None:
    world = BodiesWorld()
    with pytest.raises(ValueError, match="not on the road"):
        world.place("a", HERE)
    with pytest.raises(ValueError, match="not on the road"):
        world.remove("a")
    world.add("a", HERE)
    with pytest.raises(ValueError, match="already"):
        world.add("a", HERE)
