"""Motions are published while they last, and combined with what is sensed."""

from __future__ import annotations

import attrs
import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from laneweave.agents.core import AgentCore
from laneweave.agents.driving.motions import FRESH_TICKS, REPEAT_TICKS, Motions
from laneweave.agents.driving.reference import Reference
from laneweave.agents.driving.stopping_points import SENSED_S
from laneweave.agents.driving.surroundings import Surroundings
from laneweave.agents.driving.tracking_problem import Gaps
from laneweave.agents.host import AgentHost
from laneweave.launch.fault_search.road.stand_ins import LightDriver
from laneweave.protocol.lattice import STRETCH_COLUMNS, Cell
from laneweave.protocol.runtime.node import Arrived, Effect, Listen, Send, Unlisten
from laneweave.protocol.vehicle.motion import cell_state
from laneweave.protocol.wire.messages import Motion, Name, Neighbour, Sense
from laneweave.protocol.wire.topics import MOTION, SENSE
from support.agent_rig import HOME, ME, MOVE_TICKS, OTHER, SCENARIO, TICK_S, Rig, up_and_running
from support.driving import Road, road_scenario
from support.states import sense_in, sent

Array = NDArray[np.float64]

LENGTH_M, LEAST_M = SCENARIO.vehicle.length_m, SCENARIO.tracking.min_gap_m
KNOWN = round(SENSED_S / TICK_S)
"""Ticks for which local sensing is extrapolated."""
BEGIN = 10
BACK: tuple[Cell, Cell] = ((1, 1), (0, 1))
"""A vehicle ahead of the home cell falls back to the next cell."""


# --- what an agent publishes ----------------------------------------------------------------------


def published(rig: Rig, ticks: int) -> list[Motion]:
    """Run and return the motions that were sent."""
    return [motion for _ in range(ticks) for motion in sent(rig.answer(), Motion)]


def test_a_motion_is_published_when_it_begins_and_every_ten_ticks() -> None:
    rig = up_and_running()
    rig.accept((0, HOME, (-1, 2)))
    begin = rig.tick
    motions = published(rig, MOVE_TICKS + 15)
    assert motions == [
        Motion(ME, 1, 0, HOME, (-1, 2), begin, MOVE_TICKS, tick)
        for tick in range(begin, begin + MOVE_TICKS, REPEAT_TICKS)
    ]
    assert len(motions) == 4


def test_the_motion_goes_out_after_command_and_state_on_a_key_of_its_own() -> None:
    rig = up_and_running()
    rig.accept((0, HOME, (-1, 2)))
    effects = [e for e in rig.hand(SENSE, rig.sense()) if isinstance(e, Send)]
    assert [effect.topic.name for effect in effects] == ["command", "state", "motion"]
    assert effects[-1].parameters == {"stretch": 0, "vehicle": ME}


def test_a_holding_vehicle_publishes_no_motion() -> None:
    assert published(up_and_running(), 25) == []


def test_an_agent_that_is_not_in_charge_publishes_no_motion() -> None:
    """A new process takes a motion over, and speaks only once a SENSE has put it in charge."""
    rig = up_and_running()
    rig.accept((0, HOME, (-1, 2)))
    begin = rig.tick
    assert len(published(rig, REPEAT_TICKS)) == 1
    rig.restart()
    assert published(rig, 1) == []  # it claims the vehicle, at a tick at which a motion is repeated
    motions = published(rig, REPEAT_TICKS)
    assert [(m.incarnation, m.begin_tick, m.tick) for m in motions] == [
        (2, begin, begin + 2 * REPEAT_TICKS)
    ]


# --- subscriptions of a host ----------------------------------------------------------------------


class Listener(LightDriver):
    """A driver that records motions."""

    heard: dict[str, list[Motion]]
    """Motions by vehicle, of all drivers; the test empties it."""

    def take_over(self, sense: Sense) -> None:
        super().take_over(sense)
        self.name = sense.vehicle

    def on_motion(self, motion: Motion) -> None:
        self.heard.setdefault(self.name, []).append(motion)


A, B, C = Name("A"), Name("B"), Name("C")


def host_of(*vehicles: Name) -> AgentHost:
    Listener.heard = {}
    return AgentHost(
        Name("p"),
        lambda name: AgentCore(name, lambda: 1, SCENARIO, Listener),
        1,
        SCENARIO.runtime,
        vehicles,
    )


def put(
    host: AgentHost, vehicle: Name, stretch: int, tick: int = 1, *, charge: int = 1
) -> list[Effect]:
    """Let a vehicle sense that it is in a stretch, and which process is in charge."""
    felt = sense_in((-stretch * STRETCH_COLUMNS, 0), tick, vehicle=vehicle, incarnation=charge)
    return list(host.handle(Arrived(SENSE, {"vehicle": vehicle}, felt), 0.0))


def of_motions(effects: list[Effect]) -> list[tuple[type, int]]:
    return [
        (type(effect), effect.parameters["stretch"])
        for effect in effects
        if isinstance(effect, (Listen, Unlisten)) and effect.topic is MOTION
    ]


def send_motion(host: AgentHost, vehicle: Name, stretch: int) -> None:
    motion = Motion(vehicle, 1, stretch, *BACK, BEGIN, MOVE_TICKS, BEGIN)
    list(host.handle(Arrived(MOTION, {"stretch": str(stretch), "vehicle": vehicle}, motion), 0))


def test_host_subscribes_to_stretches_around_vehicles_in_charge() -> None:
    host = host_of(A, B)
    assert of_motions(put(host, A, 4, charge=0)) == []
    assert of_motions(put(host, A, 4, 2)) == [(Listen, 3), (Listen, 4), (Listen, 5)]
    assert of_motions(put(host, A, 4, 3)) == []
    assert of_motions(put(host, B, 5)) == [(Listen, 6)]
    assert of_motions(put(host, A, 4, 4, charge=9)) == [(Unlisten, 3)]
    assert of_motions(put(host, B, 5, 2, charge=9)) == [(Unlisten, 4), (Unlisten, 5), (Unlisten, 6)]


def test_an_agent_that_has_left_wants_no_motions() -> None:
    rig = up_and_running()
    assert rig.agent.wanted_motions == (-1, 0, 1)
    rig.hand(SENSE, rig.sense(left=True))
    assert not rig.agent.wanted_motions


def test_motions_go_to_near_agents_except_the_sender() -> None:
    host = host_of(A, B, C)
    for vehicle, stretch in ((A, 4), (B, 5), (C, 6)):
        put(host, vehicle, stretch)
    send_motion(host, B, 5)
    send_motion(host, A, 4)
    send_motion(host, Name("D"), 7)
    heard = {name: [motion.vehicle for motion in each] for name, each in Listener.heard.items()}
    assert heard == {A: [B], B: [A], C: [B, "D"]}


def test_an_agent_that_is_not_in_charge_receives_no_motions() -> None:
    host = host_of(A, B)
    put(host, A, 4, charge=0)
    put(host, B, 4)
    send_motion(host, C, 4)
    assert set(Listener.heard) == {B}


# --- what the surroundings make of it -------------------------------------------------------------


def motion(
    cells: tuple[Cell, Cell] = BACK, *, name: Name = OTHER, incarnation: int = 1, tick: int = BEGIN
) -> Motion:
    return Motion(name, incarnation, 0, *cells, BEGIN, MOVE_TICKS, tick)


def path(tick: int, cells: tuple[Cell, Cell] = BACK) -> Array:
    """Return the reference (N + 1, 6) of another vehicle's motion from a tick on."""
    return Reference.move(SCENARIO, SCENARIO.vehicle, *cells, BEGIN).window(tick).states


def neighbour(
    states: Array, lane: int, tick: int, *, off_m: float = 0.0, off_mps: float = 0.0
) -> Neighbour:
    """Return a neighbour of the home cell whose commanded state is off its reference."""
    s, v, a = states[0, :3].tolist()
    lag_s = SCENARIO.vehicle.actuator_lag_s
    speed_mps = v + off_mps - lag_s * a
    front_m = s + off_m - lag_s * (speed_mps - SCENARIO.formation.speed_mps)
    gap_m = abs(front_m - cell_state(SCENARIO.lattice, HOME, tick * TICK_S)[0]) - LENGTH_M
    return Neighbour(lane, gap_m, speed_mps, a)


def gaps(
    around: Surroundings,
    tick: int,
    ahead: tuple[Neighbour, ...] = (),
    behind: tuple[Neighbour, ...] = (),
    lane: int = HOME[1],
) -> Gaps:
    """Return what others leave a vehicle in the home cell."""
    felt = sense_in(HOME, tick, ahead=ahead, behind=behind)
    return around.gaps(felt, felt.measured, lane)


def hearing(*motions: Motion) -> Surroundings:
    around = Surroundings(SCENARIO, SCENARIO.vehicle)
    for each in motions:
        around.on_motion(each)
    return around


@pytest.mark.parametrize("off_m", [0.0, 0.8, -0.8])
def test_a_vehicle_ahead_is_predicted_along_its_motion_from_its_sensed_position(
    off_m: float,
) -> None:
    states = path(20)
    found = gaps(hearing(motion()), 20, (neighbour(states, 1, 20, off_m=off_m),)).latest
    assert found is not None
    expected = states[:, 0] + off_m - LENGTH_M - LEAST_M
    assert found[KNOWN + 1 :] == pytest.approx(expected[KNOWN + 1 :], abs=1e-9)
    assert found[0] == pytest.approx(expected[0], abs=1e-9)
    assert (found <= expected + 1e-9).all()


def test_a_vehicle_behind_is_predicted_along_its_motion() -> None:
    cells = ((-3, 1), (-2, 1))
    states = path(20, cells)
    found = gaps(hearing(motion(cells)), 20, behind=(neighbour(states, 1, 20),)).earliest
    assert found is not None
    expected = states[:, 0] + LENGTH_M + LEAST_M
    assert found[KNOWN + 1 :] == pytest.approx(expected[KNOWN + 1 :], abs=1e-9)


def beyond_sensing(around: Surroundings, tick: int, *seen: Neighbour, lane: int = 1) -> bool:
    """Return whether a vehicle ahead is predicted for longer than local sensing can."""
    latest = gaps(around, tick, seen, lane=lane).latest
    return latest is not None and bool(np.isfinite(latest[KNOWN + 1 :]).any())


def test_a_motion_counts_only_for_a_vehicle_at_its_place() -> None:
    around, states = hearing(motion()), path(20)
    assert beyond_sensing(around, 20, neighbour(states, 1, 20))
    for off_m in (2.0, -2.0):
        assert not beyond_sensing(around, 20, neighbour(states, 1, 20, off_m=off_m))
    for off_mps in (1.5, -1.5):
        assert not beyond_sensing(around, 20, neighbour(states, 1, 20, off_mps=off_mps))
    assert not beyond_sensing(around, 20, neighbour(states, 2, 20), lane=2)


def test_a_sensed_vehicle_counts_whatever_its_motion() -> None:
    """A forged motion, at the place of a vehicle that slows down, claims that it drives away."""
    scenario = attrs.evolve(SCENARIO, tracking=attrs.evolve(SCENARIO.tracking, min_gap_m=9.0))
    away: tuple[Cell, Cell] = ((0, 1), (1, 1))
    seen = neighbour(path(BEGIN, away), 1, BEGIN, off_m=-0.5, off_mps=-0.8)
    plain, misled = (
        Surroundings(scenario, scenario.vehicle),
        Surroundings(scenario, scenario.vehicle),
    )
    misled.on_motion(motion(away))
    sensed, both = gaps(plain, BEGIN, (seen,)).latest, gaps(misled, BEGIN, (seen,)).latest
    assert sensed is not None
    assert both is not None
    assert (both[: KNOWN + 1] == sensed[: KNOWN + 1]).all()
    said = path(BEGIN, away)[:, 0] - path(BEGIN, away)[0, 0] + sensed[0]
    assert said[KNOWN] > sensed[KNOWN] + 0.5


def test_a_vehicle_that_drives_as_announced_sets_no_bound_of_stopping_points() -> None:
    """Plans leave room behind it; one that deviates may be braking."""
    states = path(20)
    seen = neighbour(states, 1, 20)
    assert seen.speed_mps < SCENARIO.formation.speed_mps - 2.0
    near = attrs.evolve(SCENARIO, braking=attrs.evolve(SCENARIO.braking, margin_m=9.0))
    announced, unknown = (Surroundings(near, near.vehicle) for _ in range(2))
    announced.on_motion(motion())
    assert gaps(unknown, 20, (seen,)).stopping is not None
    assert gaps(announced, 20, (seen,)).stopping is None
    slower = neighbour(states, 1, 20, off_mps=-1.5)
    assert gaps(announced, 20, (slower,)).stopping is not None
    assert gaps(announced, 20, (seen, slower)).stopping is not None


def test_a_motion_that_has_ended_or_was_not_repeated_does_not_count() -> None:
    for tick, repeats, counts in (
        (BEGIN + FRESH_TICKS, 0, True),
        (BEGIN + FRESH_TICKS + 1, 0, False),
        (BEGIN + FRESH_TICKS + 1, 1, True),
        (BEGIN + MOVE_TICKS - 1, 3, True),
        (BEGIN + MOVE_TICKS, 3, False),
    ):
        said = [motion(tick=BEGIN + n * REPEAT_TICKS) for n in range(repeats + 1)]
        around = hearing(*said, said[0])  # a duplicate that is late makes nothing older
        assert beyond_sensing(around, tick, neighbour(path(tick), 1, tick)) is counts, tick


def test_a_motion_that_comes_when_it_has_ended_does_not_count() -> None:
    """Also within the tick in which others were forgotten already."""
    tick = BEGIN + MOVE_TICKS
    third = replace(motion(name=Name("third")), begin_tick=tick, tick=tick)
    around, seen = hearing(third), neighbour(path(tick), 1, tick)
    assert not beyond_sensing(around, tick, seen)
    around.on_motion(motion(tick=tick - 1))
    assert not beyond_sensing(around, tick, seen)


def test_motions_that_do_not_count_any_more_are_forgotten() -> None:
    motions = Motions(SCENARIO)
    names = [Name(f"v{number}") for number in range(20)]
    for name in names:
        motions.add(motion(name=name))
    assert len(motions.known) == 20
    motions.advance(BEGIN + MOVE_TICKS)
    assert len(motions.known) == 0


def test_the_newest_incarnation_and_then_the_newest_motion_counts() -> None:
    states = path(20)
    seen = neighbour(states, 1, 20)
    elsewhere: tuple[Cell, Cell] = ((5, 0), (5, 1))
    newer = motion(elsewhere, incarnation=2)
    assert not beyond_sensing(hearing(motion(), newer), 20, seen)
    assert not beyond_sensing(hearing(newer, motion()), 20, seen)
    assert beyond_sensing(hearing(motion(elsewhere), motion(incarnation=2)), 20, seen)
    later = replace(motion(elsewhere), begin_tick=BEGIN + 5)
    assert not beyond_sensing(hearing(motion(), later), 20, seen)
    assert not beyond_sensing(hearing(later, motion()), 20, seen)
    older = replace(motion(elsewhere), begin_tick=BEGIN - 5)
    assert beyond_sensing(hearing(motion(), older), 20, seen)


def test_a_motion_counts_while_its_body_touches_a_lane_that_counts() -> None:
    out: tuple[Cell, Cell] = ((0, 1), (0, 2))
    tick = BEGIN + 5
    states = path(tick, out)
    seen = neighbour(states, 1, tick)
    found = gaps(hearing(motion(out)), tick, (seen,)).latest
    assert found is not None
    right_m = states[:, 3] - SCENARIO.vehicle.width_m / 2.0
    left_lane_m = 2 * SCENARIO.road.lane_width_m
    assert np.isfinite(found[right_m < left_lane_m]).all()
    assert np.isinf(found[-1])
    # For a vehicle that enters that lane, it does not leave at all.
    found = gaps(hearing(motion(out)), tick, (seen,), lane=2).latest
    assert found is not None
    assert np.isfinite(found).all()


@pytest.mark.parametrize(
    "nonsense",
    [
        motion(((1, 1), (1, 1))),
        motion(((1, 1), (3, 1))),
        motion(((1, 1), (0, 2))),  # oblique, which mode 1 does not know
        motion(((2**63 - 1, 2**63 - 1), (-(2**63), 0))),
        replace(motion(), ticks=MOVE_TICKS - 1),  # no slot of this scenario lasts so long
        replace(motion(), ticks=0),
        replace(motion(), ticks=2**63 - 1),
        replace(motion(), ticks=-(2**63)),
        replace(motion(), begin_tick=2**63 - 1, tick=-(2**63)),
        replace(motion(), begin_tick=-(2**63), tick=2**63 - 1),
    ],
)
def test_implausible_motions_are_ignored(nonsense: Motion) -> None:
    seen = neighbour(path(20), 1, 20)
    assert not beyond_sensing(hearing(nonsense), 20, seen)
    assert beyond_sensing(hearing(nonsense, motion(name=Name("third"))), 20, seen)


# --- in closed loop -------------------------------------------------------------------------------

FIRST, SECOND = Name("first"), Name("second")
LEAST_APART_M = 12.0
"""Larger than the distance between two holding vehicles: the second one has to give way."""


def follow(seed: int, *, broadcast: bool) -> tuple[Array, Array]:
    """Return the follower's accelerations and the gap, by tick, while the first one falls back."""
    scenario = road_scenario(seed)
    scenario = attrs.evolve(
        scenario, tracking=attrs.evolve(scenario.tracking, min_gap_m=LEAST_APART_M)
    )
    road = Road(scenario, {FIRST: (0, 1), SECOND: (-2, 1)})
    road.broadcast = broadcast
    for tick in range(80):
        road.step({FIRST: (0, (0, 1), (-1, 1))} if tick == BEGIN else {})
    states = np.array(road.record.states)
    return states[:, 1, 2], states[:, 0, 0] - states[:, 1, 0] - scenario.vehicle.length_m


@pytest.mark.parametrize("seed", [0, 1])
def test_a_known_motion_makes_the_follower_brake_earlier_and_less(seed: int) -> None:
    surprised, _ = follow(seed, broadcast=False)
    warned, gap_m = follow(seed, broadcast=True)
    assert gap_m.min() > LEAST_APART_M
    assert warned.min() > 0.85 * surprised.min()
    early = slice(BEGIN, BEGIN + 10)
    assert warned[early].min() < surprised[early].min() - 0.3
