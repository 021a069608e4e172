"""The bridge with real agents on the simulated network: faults, whole runs, the run after it."""

from __future__ import annotations

from pathlib import Path

import pytest

from laneweave.agents.host import RETURN_S
from laneweave.coordinator.core import CoordinatorCore
from laneweave.protocol.lattice import Cell
from laneweave.protocol.transports.simulated.virtual_time import Conditions
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel
from laneweave.sim_bridge.core import CATCH_UP_S, BridgeMetrics, TickPhase
from support.bridge_bench import (
    A,
    B,
    Sleeper,
    Street,
    arrival,
    deadlines_until_silent,
    make_scenario,
    read_events,
    read_summary,
)
from support.variants import variants

LONG_ROAD = make_scenario(road={"lanes": 3, "s1_m": 20.0, "s2_m": 20.0, "s3_m": 400.0})
SHORT_ROAD = make_scenario(sensing={})
"""With errors of measurement."""
TICK_S, LATTICE = LONG_ROAD.runtime.tick_s, LONG_ROAD.lattice
BODY, LANE_M = LONG_ROAD.vehicle, LONG_ROAD.road.lane_width_m
HOME: Cell = (-1, 1)
"""Where vehicle A is: in the middle of its block, and of the road."""
MOVE_TICK = 70
SILENT_S, MISSES = LONG_ROAD.runtime.agent_silent_s, deadlines_until_silent(LONG_ROAD)
MOVE_TICKS = round(LONG_ROAD.timing.move_s / TICK_S)
PACE = 5.0
"""A tick takes 20 ms if all agents answer."""
PLAY_M = 0.5
MOVES: tuple[Cell, ...] = ((0, 1), (-2, 1), (-1, 2), (-1, 0), (0, 2), (-2, 0))


@pytest.fixture
def street(tmp_path: Path) -> Street:
    """A and B will be on the road, of which A is about to move; B has a process."""
    street = Street(LONG_ROAD, tmp_path, [arrival(A, 1.0, 1), arrival(B, 6.0, 0)], pace=PACE)
    street.start_agents(B)
    return street


@pytest.fixture
def agent(street: Street) -> Sleeper:
    """The process of A, which is on the road."""
    agent = street.start_agents(A)
    street.run_to(40)
    assert street.bridge.vehicles[A].controller.hold_cell == HOME
    return agent


def seen_in_cell(street: Street) -> list[tuple[float, float]]:
    """Return where A was shown after each tick: m from its first cell along and across."""
    column, lane = HOME
    return [
        (
            poses[A][0] - LATTICE.cell_s_m(column, (index + 1) * TICK_S),
            poses[A][1] - LATTICE.cell_y_m(lane),
        )
        for index, poses in enumerate(street.world.shown)
        if A in poses
    ]


def way(target: Cell) -> tuple[float, float]:
    return (target[0] - HOME[0]) * LATTICE.pitch_m, (target[1] - HOME[1]) * LANE_M


def check_between_cells(street: Street, target: Cell) -> None:
    """Check that A was always between its two cells, and its body in the lanes of both."""
    along_m, across_m = way(target)
    room_m = (LANE_M - BODY.width_m) / 2
    for along, across in seen_in_cell(street):
        assert min(along_m, 0.0) - PLAY_M <= along <= max(along_m, 0.0) + PLAY_M
        play_m = min(PLAY_M, room_m)
        assert min(across_m, 0.0) - play_m <= across <= max(across_m, 0.0) + play_m


def check_arrived(street: Street, target: Cell) -> None:
    assert seen_in_cell(street)[-1] == pytest.approx(way(target), abs=0.1)
    assert street.bridge.vehicles[A].controller.hold_cell == target


# --- an agent that sleeps ---------------------------------------------------------------------


def sleep(street: Street, agent: Sleeper, target: Cell, tick: int, asleep_ticks: int) -> None:
    """Order a move of A, whose agent then sleeps from a tick on."""
    street.order(A, target, MOVE_TICK * TICK_S)
    street.run_to(tick)
    agent.asleep = True
    street.run_to(tick + asleep_ticks)


@pytest.mark.parametrize("target", MOVES)
@pytest.mark.parametrize("asleep_ticks", variants([7, 3, 5]))
def test_an_agent_that_slept_while_its_move_began_moves_from_where_the_body_is(
    street: Street, agent: Sleeper, target: Cell, asleep_ticks: int
) -> None:
    """It answers all that it missed at once, as if it had moved at that time: nothing is played."""
    sleep(street, agent, target, MOVE_TICK - 2, asleep_ticks)
    assert seen_in_cell(street)[-1] == pytest.approx((0.0, 0.0), abs=1e-6)
    agent.asleep = False
    street.run_to(MOVE_TICK + 2 * asleep_ticks + 60)
    check_between_cells(street, target)
    check_arrived(street, target)
    assert read_events(street.folder, "agent-silent") == []


@pytest.mark.parametrize("target", MOVES)
@pytest.mark.parametrize("asleep_ticks", variants([25, 60]))
def test_an_agent_that_slept_until_its_vehicle_was_taken_care_of_does_not_move(
    street: Street, agent: Sleeper, target: Cell, asleep_ticks: int
) -> None:
    """The caretaker may have promised its cell to others: it is back in charge, without a plan."""
    sleep(street, agent, target, MOVE_TICK - 2, asleep_ticks)
    assert A in street.bridge.road.caretakers
    agent.asleep = False
    street.run_to(MOVE_TICK + asleep_ticks + 100)
    assert seen_in_cell(street)[-1] == pytest.approx((0.0, 0.0), abs=0.1)
    check_between_cells(street, HOME)
    check_in_charge_without_plan(street, HOME)


def check_in_charge_without_plan(street: Street, cell: Cell) -> None:
    agent = street.agents[A]
    assert A not in street.bridge.road.caretakers
    assert agent.in_charge
    execution = agent.execution
    assert execution is not None
    assert (execution.hold_cell, execution.moving, execution.plan) == (cell, False, None)
    took_over = [
        (event["kind"], event["vehicle"])
        for kind in ("agent-silent", "caretaker-took-over", "agent-took-over")
        for event in read_events(street.folder, kind)
    ]
    assert took_over == [("agent-silent", A), ("caretaker-took-over", A), ("agent-took-over", A)]


@pytest.mark.parametrize("target", [(0, 1), (-1, 2), (0, 2)])
@pytest.mark.parametrize("asleep_ticks", variants([25, MISSES - 1, 40]))
def test_an_agent_that_slept_in_its_move_finds_the_body_further_on(
    street: Street, agent: Sleeper, target: Cell, asleep_ticks: int
) -> None:
    sleep(street, agent, target, MOVE_TICK + 10, asleep_ticks)
    agent.asleep = False
    street.run_to(MOVE_TICK + 100)
    check_between_cells(street, target)
    check_arrived(street, target)
    if asleep_ticks < MISSES:
        execution = street.agents[A].execution
        assert execution is not None
        assert (execution.moving, execution.done) == (False, True)
    else:
        check_in_charge_without_plan(street, target)


def test_ticks_do_not_wait_long_for_an_agent_that_sleeps(street: Street, agent: Sleeper) -> None:
    street.run_to(90)  # B is there, too
    agent.asleep = True
    began_s = street.network.now_s
    street.run_to(190)
    # It misses some deadlines; the other ticks keep the pace of the run, and make up for a part.
    assert street.network.now_s - began_s == pytest.approx(
        (100 - MISSES) * TICK_S / PACE + SILENT_S - CATCH_UP_S, abs=0.3
    )
    agent.asleep = False
    street.run_to(200)
    assert street.bridge.road.answers.silent == set()


# --- an agent that dies -----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("target", [(0, 1), (-1, 2), (-2, 0)])
@pytest.mark.parametrize("restarts", [False, True])
def test_the_move_of_an_agent_that_died_is_finished_and_held(
    tmp_path: Path, street: Street, agent: Sleeper, target: Cell, *, restarts: bool
) -> None:
    assert not agent.asleep
    undisturbed = Street(LONG_ROAD, tmp_path / "other", street.arrivals)
    undisturbed.start_agents(A)
    undisturbed.start_agents(B)
    undisturbed.run_to(40)
    for each in (undisturbed, street):
        each.order(A, target, MOVE_TICK * TICK_S)
        each.run_to(MOVE_TICK + 15)
    street.network.kill("agent-A")
    street.run_to(MOVE_TICK + 20)
    if restarts:
        street.start_agents(A)
        street.run_to(MOVE_TICK + 25)
        execution = street.agents[A].execution
        assert execution is not None
        assert (execution.hold_cell, execution.moving, execution.plan) == (target, True, None)
    for each in (undisturbed, street):
        each.run_to(MOVE_TICK + MOVE_TICKS + 40)
    for (along, across), expected in zip(
        seen_in_cell(street), seen_in_cell(undisturbed), strict=False
    ):
        assert (along, across) == pytest.approx(expected, abs=0.1)
    check_arrived(street, target)
    level_ticks = street.bridge.vehicles[A].controller.level_ticks
    assert (level_ticks[FallbackLevel.HOLD] > 0) == (not restarts)
    assert level_ticks[FallbackLevel.EMERGENCY] == 0
    if restarts:
        execution = street.agents[A].execution
        assert execution is not None
        assert not execution.moving


# --- whole runs -------------------------------------------------------------------------------

MANY = tuple(
    arrival(f"v{number:04d}", number + 2.0, number % 2, (number // 2) % 2) for number in range(7)
)
"""Each comes when a cell does, as there is no room to settle; some want the other lane."""


def check_complete(street: Street, folder: Path) -> None:
    summary = read_summary(folder)
    vehicles = summary["vehicles"]
    assert summary["ending"] == "complete"
    assert vehicles["left"] == vehicles["entered"] == vehicles["demanded"] == len(MANY)
    assert summary["safety"]["overlaps"] == 0
    bridge = street.bridge
    for left_over in (
        bridge.vehicles,
        bridge.road.answers.silent,
        bridge.road.answers.awaited,
        bridge.road.at_entrance,
    ):
        assert not left_over


def check_all_gone(street: Street) -> None:
    """Check that nothing is kept of vehicles that are no more."""
    bridge = street.bridge
    # The last one's token may vanish after its report, with which the run is over.
    assert set(bridge.road.caretakers.departed) <= bridge.road.answers.up <= {MANY[-1].vehicle}
    assert not bridge._unreported
    for node in street.nodes:
        assert not getattr(node.core, "_agents", None)


@pytest.mark.slow
@pytest.mark.parametrize("shards", [1, 2, None])
def test_a_whole_run_counts_every_message_once_and_keeps_little_of_vehicles_that_left(
    tmp_path: Path, shards: int | None
) -> None:
    """However many vehicles share a process, the summary counts what all processes published."""
    street = Street(SHORT_ROAD, tmp_path, MANY)
    for index in range(shards or 0):
        street.start_shard(index, shards or 0)
    for vehicle in () if shards else MANY:
        street.start_agents(vehicle.vehicle)
    bridge, most = street.bridge, 0
    ended_s: list[float] = []

    def look() -> bool:
        nonlocal most
        most = max(most, len(bridge.road.caretakers.departed))
        if bridge.phase is TickPhase.SHUTTING_DOWN and not ended_s:
            ended_s.append(street.network.now_s)
        return bridge.phase is TickPhase.ENDED

    street.run(look)
    check_complete(street, tmp_path)
    summary = read_summary(tmp_path)
    published = [node.published for node in street.nodes]
    assert min(published) > 50
    assert summary["messages"]["published"] == sum(published)
    assert summary["messages"]["rejected"] == 0
    assert summary["tracking"]["hold_law_ticks"] == 0
    assert read_events(tmp_path, "agent-missing") == read_events(tmp_path, "agent-silent") == []
    assert most == 1  # until its agent's token is gone, not for all the repeats
    assert street.network.now_s - ended_s[0] < 0.1  # the reports were there: no waiting
    if shards is None:
        # Each when its vehicle had left, and nothing has shown for a while that it had not.
        street.network.run(street.network.now_s + 2.0 * RETURN_S)
        assert all(node.ended for node in street.nodes)
    else:
        check_all_gone(street)


def test_a_bad_network_slows_a_run_down_and_nothing_else(tmp_path: Path) -> None:
    conditions = Conditions(jitter_s=0.05, loss=0.1, duplication=0.1)
    street = Street(SHORT_ROAD, tmp_path, MANY, conditions)
    street.start_coordinators(2)
    for index in range(2):
        street.start_shard(index, 2)
    street.run()
    check_complete(street, tmp_path)
    assert read_events(tmp_path, "agent-silent") == []


def test_at_half_of_all_messages_lost_the_road_keeps_real_time_and_agents_stay_in_charge(
    tmp_path: Path,
) -> None:
    """A quarter of the rounds between bridge and agent succeed; each agent still answers."""
    street = Street(LONG_ROAD, tmp_path, MANY, Conditions(loss=0.5), pace=PACE)
    for one in MANY:
        street.start_agents(one.vehicle)
    street.run_to(150)
    began_s, tick, missed = street.network.now_s, street.bridge.tick, missed_ticks(street)
    street.run_to(350)
    ticks = street.bridge.tick - tick
    assert street.network.now_s - began_s < ticks * TICK_S
    assert missed_ticks(street) - missed < 0.03 * ticks * len(MANY)
    assert read_events(tmp_path, "caretaker-took-over") == []


@pytest.mark.parametrize("delay_s", variants([0.02, 0.002]))
def test_messages_that_are_not_lost_are_waited_for(tmp_path: Path, delay_s: float) -> None:
    """A process that is late now and then, or a long way, is no reason to hurry."""
    conditions = Conditions(delay_s=delay_s, jitter_s=0.06)
    street = Street(LONG_ROAD, tmp_path, MANY, conditions, pace=PACE)
    for one in MANY:
        street.start_agents(one.vehicle)
    street.run_to(250)
    assert not street.bridge.road.answers.lossy
    assert missed_ticks(street) == 0


def missed_ticks(street: Street) -> int:
    (metrics,) = street.bridge.metrics
    assert isinstance(metrics, BridgeMetrics)
    return metrics.missed_answers_total


def test_the_clock_does_not_race_while_the_bridge_is_off_the_network(tmp_path: Path) -> None:
    street = Street(SHORT_ROAD, tmp_path, MANY)
    street.bridge._pace._duration_s = 1e-3  # as fast as agents answer
    street.start_shard()
    street.run_to(60)
    street.network.disconnect("bridge")
    tick, began_s = street.bridge.tick, street.network.now_s
    street.run(lambda: street.network.now_s >= began_s + 4.0)
    assert street.bridge.tick - tick <= 4.0 / TICK_S + 1
    street.network.reconnect("bridge")
    street.run()
    check_complete(street, tmp_path)


# --- the next run -----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("end_of_first", variants(["killed", "in good order"]))
def test_all_roles_start_anew_with_the_next_bridge(tmp_path: Path, end_of_first: str) -> None:
    """Its vehicles have the names of the last ones, and its road time begins at 0 again."""
    street = Street(SHORT_ROAD, tmp_path / "first", MANY)
    street.start_coordinators(2)
    host = street.start_shard()
    if end_of_first == "killed":
        street.run_to(90)
        assert len(street.bridge.vehicles) > 2
        street.network.kill("bridge")
    else:
        street.run()
        check_complete(street, tmp_path / "first")
    street.network.run(street.network.now_s + 3.0)
    old_agents = dict(street.agents)

    street.start_bridge("next-bridge", tmp_path / "second")
    street.run_to(20)
    for node in street.nodes:
        if isinstance(node.core, CoordinatorCore):
            assert node.core.t_s <= street.bridge.t_s
            assert node.core.census is not None
            assert node.core.census.t_s <= street.bridge.t_s
    assert host._agents
    assert not set(map(id, host._agents.values())) & set(map(id, old_agents.values()))
    street.run()

    check_complete(street, tmp_path / "second")
    check_all_gone(street)
    summary = read_summary(tmp_path / "second")
    planning = summary["planning"]
    assert planning["plans"] > 0
    assert planning["by_solver"] == {"tappa": planning["plans"], "branching": 0}
    assert planning["fallbacks"] == 0
    assert summary["vehicles"]["on_preferred_lane"] == len(MANY)
    assert summary["tracking"]["hold_law_ticks"] == 0
    assert read_events(tmp_path / "second", "agent-missing") == []
    assert read_events(tmp_path / "second", "agent-silent") == []


def test_agents_of_named_vehicles_follow_the_next_bridge(tmp_path: Path) -> None:
    """Their vehicles are not left to the caretaker although ticks begin again at 0."""
    street = Street(SHORT_ROAD, tmp_path / "first", [arrival("v1", 0.5)])
    street.start_agents("v1")
    street.run_to(90)
    street.network.kill("bridge")
    street.network.run(street.network.now_s + 3.0)
    street.start_bridge("next-bridge", tmp_path / "second")
    street.run()
    summary = read_summary(tmp_path / "second")
    assert (summary["ending"], summary["vehicles"]["left"]) == ("complete", 1)
    assert summary["tracking"]["hold_law_ticks"] == 0
    assert summary["tracking"]["caretaker_takeovers"] == 0
