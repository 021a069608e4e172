"""In which ticks the bridge sends a SENSE to a vehicle that holds undisturbed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from laneweave.protocol.runtime.node import Arrived
from laneweave.protocol.scenario.deployment_fields import MAX_HOLD_S
from laneweave.protocol.vehicle.motion import cell_state
from laneweave.protocol.wire.bounds import MAX_MOTION_TICKS
from laneweave.protocol.wire.messages import (
    Ballot,
    ClosedFormation,
    CurrentMotion,
    Heartbeat,
    Name,
    Neighbour,
)
from laneweave.protocol.wire.topics import HEARTBEAT
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel, OffLatticePhase
from laneweave.sim_bridge.bodies.overlaps_and_gaps import NO_NEIGHBOURS, Neighbours
from laneweave.sim_bridge.road.sense_rate import ACCEL_MPS2, GAP_M, SPEED_MPS
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.bridge_bench import ROAD, TWO, A, B, Desk, asked, make_scenario

PERIOD = 5


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    """Two vehicles on the road that have settled, each with an agent that has claimed it."""
    desk = Desk(make_scenario(road={**ROAD, "s3_m": 6000.0}), tmp_path, TWO)
    desk.start(A, B)
    desk.drive_to(30)
    for vehicle in desk.core.vehicles.values():
        controller = vehicle.controller
        controller.plant._state = cell_state(controller.lattice, vehicle.cell, desk.core.t_s)
        controller.perceive(vehicle.state, NO_NEIGHBOURS)
    return desk


def hold(desk: Desk, vehicle: str, ticks: int = PERIOD) -> None:
    """Let an agent answer that its vehicle holds undisturbed."""
    cell = desk.core.vehicles[Name(vehicle)].cell
    desk.answer(vehicle, motion=CurrentMotion(cell, 0, ticks))


def next_tick(desk: Desk, *answering: str) -> list[str]:
    """Let agents answer, and the next tick begin; return who gets a SENSE."""
    for vehicle in answering:
        desk.answer(vehicle)
    return asked(desk.wake())


def test_a_vehicle_that_holds_undisturbed_gets_the_next_sense_after_its_period(desk: Desk) -> None:
    hold(desk, A)
    tick = desk.core.tick
    assert next_tick(desk, B) == [B]
    assert desk.core.road.answers.awaited == {B}  # the tick waits for nobody else
    for _ in range(PERIOD - 2):
        assert next_tick(desk, B) == [B]
    assert next_tick(desk, B) == [A, B]
    assert desk.core.tick == tick + PERIOD
    assert next_tick(desk, A, B) == [A, B]


def test_a_tick_in_which_nobody_is_asked_goes_by_itself(desk: Desk) -> None:
    hold(desk, A)
    hold(desk, B)
    for _ in range(PERIOD - 1):
        assert next_tick(desk) == []
    assert next_tick(desk) == [A, B]


def test_the_period_is_bounded(desk: Desk) -> None:
    hold(desk, A, MAX_MOTION_TICKS)
    most = round(MAX_HOLD_S / desk.scenario.runtime.tick_s)
    assert [A in next_tick(desk, B) for _ in range(most)] == [False] * (most - 1) + [True]


def test_the_end_of_a_move_as_agents_of_earlier_releases_send_it_is_no_rest(desk: Desk) -> None:
    cell = desk.core.vehicles[A].cell
    controller = desk.core.vehicles[A].controller
    controller.motion = CurrentMotion((cell[0] + 1, cell[1]), 0, 38)
    desk.answer(A, motion=controller.motion)
    assert next_tick(desk, B) == [A, B]


def test_what_an_agent_sends_between_two_ticks_ends_the_rest(desk: Desk) -> None:
    """It is for the tick that the agent has answered; a repeated answer means nothing new."""
    tick = desk.core.tick
    hold(desk, A)
    assert next_tick(desk, B) == [B]
    desk.answer(A, tick=tick)
    assert next_tick(desk, B) == [A, B]
    hold(desk, A)
    tick = desk.core.tick
    assert next_tick(desk, B) == [B]
    cell = desk.core.vehicles[A].cell
    desk.answer(A, tick=tick, motion=CurrentMotion(cell, 0, PERIOD))
    assert next_tick(desk, B) == [B]


def test_what_an_agent_stores_is_confirmed_at_once_and_ends_the_rest(desk: Desk) -> None:
    hold(desk, A)
    assert next_tick(desk, B) == [B]
    accepted = Ballot(1, Name("c1"), 1, 0)
    confirmed = desk.answer(A, tick=desk.core.tick - 1, accepted=accepted)
    assert asked(confirmed) == [A]
    assert next_tick(desk, B) == [A, B]


def pushed(vehicle: RoadVehicle) -> None:
    s, v, a, y, v_y, a_y = vehicle.state
    vehicle.controller.perceive((s - 1.0, v, a, y, v_y, a_y), NO_NEIGHBOURS)


def refused(vehicle: RoadVehicle) -> None:
    vehicle.controller.level = FallbackLevel.GIVE_WAY


def off_lattice(vehicle: RoadVehicle) -> None:
    vehicle.controller.off_lattice = OffLatticePhase.WAITING


def joined(vehicle: RoadVehicle) -> None:
    vehicle.join(ClosedFormation(vehicle.block, vehicle.block, 1.0))


def replaced(vehicle: RoadVehicle) -> None:
    vehicle.controller.store.put_in_charge(vehicle.controller.record.incarnation + 1)


def moved(vehicle: RoadVehicle) -> None:
    vehicle.controller.motion = CurrentMotion(vehicle.cell, 10_000)


@pytest.mark.parametrize("change", [pushed, refused, off_lattice, joined, replaced, moved])
def test_any_change_of_the_vehicle_ends_the_rest(
    desk: Desk, change: Callable[[RoadVehicle], None]
) -> None:
    hold(desk, A)
    vehicle = desk.core.vehicles[A]
    assert not vehicle.needs_sense(desk.core.tick)
    change(vehicle)
    assert vehicle.needs_sense(desk.core.tick)
    assert vehicle.needs_sense(desk.core.tick)


@pytest.mark.parametrize("behind", [False, True])
def test_a_neighbour_in_the_lane_that_moves_ends_the_rest(desk: Desk, *, behind: bool) -> None:
    vehicle, tick = desk.core.vehicles[A], desk.core.tick
    controller, lane = vehicle.controller, vehicle.cell[1]
    rest = desk.command(A, motion=CurrentMotion(vehicle.cell, 0, PERIOD))
    one = Neighbour(lane=lane, gap_m=10.0, speed_mps=15.0)

    def look(*near: Neighbour) -> None:
        controller.neighbours = Neighbours((), near) if behind else Neighbours(near, ())

    def is_disturbed(*near: Neighbour) -> bool:
        look(one)
        vehicle.hold(rest)
        look(*near)
        return vehicle.needs_sense(tick)

    for name, limit in (("gap_m", GAP_M), ("speed_mps", SPEED_MPS), ("accel_mps2", ACCEL_MPS2)):
        for sign in (-1.0, 1.0):
            value = getattr(one, name)
            assert not is_disturbed(replace(one, **{name: value + 0.9 * sign * limit}))
            assert is_disturbed(replace(one, **{name: value + 1.1 * sign * limit}))
    assert is_disturbed()
    assert is_disturbed(one, one)
    assert is_disturbed(replace(one, lane=lane + 1))
    assert not is_disturbed(one, replace(one, lane=lane + 1, gap_m=3.0, speed_mps=9.0))


def test_another_process_of_the_vehicle_is_asked_in_the_next_tick(desk: Desk) -> None:
    hold(desk, A)
    assert next_tick(desk, B) == [B]
    desk.up(A)
    assert next_tick(desk, B) == [A, B]


def test_a_claim_is_confirmed_in_the_next_tick_whatever_it_says(desk: Desk) -> None:
    cell = desk.core.vehicles[A].cell
    desk.answer(A, incarnation=7, motion=CurrentMotion(cell, 0, PERIOD))
    assert desk.core.vehicles[A].controller.record.incarnation == 7
    assert next_tick(desk, B) == [A, B]


def test_a_coordinator_that_begins_to_lead_gets_the_states_of_all(desk: Desk) -> None:
    hold(desk, A)
    assert next_tick(desk, B) == [B]
    beat = Heartbeat(Name("c2"), 5, 3, leading=True, plans=0)
    assert asked(desk.give(Arrived(HEARTBEAT, {"coordinator": "c2"}, beat))) == [A]  # at once
    assert next_tick(desk, B) == [A, B]
    hold(desk, A)
    desk.give(Arrived(HEARTBEAT, {"coordinator": "c2"}, beat))
    desk.give(
        Arrived(
            HEARTBEAT, {"coordinator": "c3"}, replace(beat, coordinator=Name("c3"), leading=False)
        )
    )
    assert next_tick(desk, B) == [B]


def test_an_agent_that_does_not_answer_after_its_rest_is_awaited(desk: Desk) -> None:
    hold(desk, A)
    for _ in range(PERIOD):
        asked_now = next_tick(desk, B)
    assert asked_now == [A, B]
    desk.answer(B)
    assert desk.core.road.answers.awaited == {A}
