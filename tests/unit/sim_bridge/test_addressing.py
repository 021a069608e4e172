"""To which processes the bridge addresses SENSE, and what the census says of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest

from laneweave.protocol.runtime.node import Effect, Send
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.wire.messages import Census, Name, Sense
from laneweave.sim_bridge.core import TickPhase
from laneweave.sim_bridge.road.caretakers import MAX_PROCESSES
from support.bridge_bench import TWO, A, B, Desk, make_scenario
from support.states import sent

F, G = "fleet-1", "fleet-2"


def addressees(effects: Iterable[Effect], vehicle: Name) -> list[str]:
    """Return the processes to which the SENSE messages of a vehicle went, in order."""
    return [
        each.parameters["process"]
        for each in effects
        if isinstance(each, Send)
        and isinstance(each.message, Sense)
        and each.parameters["vehicle"] == vehicle
    ]


def next_tick(desk: Desk) -> list[Effect]:
    """Let the agents answer; return what is sent in the next tick."""
    desk.effects.clear()
    desk.drive_to(desk.core.tick + 1)
    return desk.effects


def in_census(desk: Desk) -> dict[Name, tuple[Name, ...]]:
    """Return the processes of the vehicles in the newest census."""
    return {each.vehicle: each.processes for each in sent(desk.effects, Census)[-1].on_road}


def test_without_a_token_the_process_has_the_name_of_the_vehicle(desk: Desk) -> None:
    assert addressees(next_tick(desk), A) == [A]
    desk.up(A)
    assert addressees(next_tick(desk), A) == [A]
    desk.drive_to(desk.core.tick + 10)
    assert in_census(desk) == {A: (), B: ()}


def test_a_token_before_the_entry_says_where_the_agent_is(tmp_path: Path) -> None:
    desk = Desk(make_scenario(), tmp_path, TWO)
    desk.start(B)
    desk.up(A, F)
    desk.drive_to_entry(A, B)
    assert set(addressees(desk.effects, A)) == {F}
    assert in_census(desk) == {A: (F,), B: ()}


def test_a_new_token_takes_effect_with_the_next_tick_and_its_census(desk: Desk) -> None:
    desk.up(A, F)
    effects = next_tick(desk)
    assert addressees(effects, A) == [F]
    assert addressees(effects, B) == [B]
    assert in_census(desk) == {A: (F,), B: ()}


def test_two_processes_with_an_agent_get_the_same(desk: Desk) -> None:
    desk.up(A, F)
    desk.up(A, G)
    effects = next_tick(desk)
    assert addressees(effects, A) == [F, G]
    assert len({id(sense) for sense in sent(effects, Sense) if sense.vehicle == A}) == 1
    assert in_census(desk)[A] == (F, G)


def test_a_vehicle_with_one_of_two_tokens_left_is_attended(desk: Desk) -> None:
    desk.up(A, F)
    desk.up(A, G)
    desk.down(A, F)
    assert addressees(next_tick(desk), A) == [G]
    assert A in desk.core.road.answers.up
    assert A not in desk.core.road.caretakers


def test_the_last_process_is_still_addressed_after_its_token_has_vanished(desk: Desk) -> None:
    """The agent may claim the vehicle again, for example after a wrong message that it has left."""
    desk.up(A, F)
    desk.down(A, F)
    assert addressees(next_tick(desk), A) == [F]
    assert A in desk.core.road.caretakers
    desk.up(A, G)
    assert addressees(next_tick(desk), A) == [G]


@pytest.mark.parametrize("order", ["link first", "tokens first", "link last"])
@pytest.mark.parametrize("stays", [False, True])
def test_after_a_lost_link_only_tokens_that_appear_again_count(
    desk: Desk, order: str, *, stays: bool
) -> None:
    """Events of link and tokens come from different threads, and so in any order."""
    desk.up(A, F)
    desk.up(A, G)
    next_tick(desk)
    if order == "link first":
        desk.give(LinkDown())
    desk.down(A, F)
    desk.down(A, G)
    if order == "tokens first":
        desk.give(LinkDown())
    if order != "link last":
        desk.give(LinkUp())
    for process in (F, G) if stays else (G,):
        desk.up(A, process)
    if order == "link last":
        desk.give(LinkDown())
        desk.give(LinkUp())
    assert addressees(next_tick(desk), A) == ([F, G] if stays else [G])


def test_a_vehicle_that_enters_after_a_lost_link_is_addressed_by_its_token(tmp_path: Path) -> None:
    desk = Desk(make_scenario(), tmp_path, TWO)
    desk.start(B)
    desk.up(A, F)
    desk.down(A, F)
    desk.up(A, F)
    desk.give(LinkDown())
    desk.give(LinkUp())
    desk.up(B)
    desk.drive_to_entry(A, B)
    assert set(addressees(desk.effects, A)) == {F}


def test_a_vehicle_is_addressed_in_few_processes(desk: Desk) -> None:
    """Tokens may be forged; those that appeared last count."""
    names = [f"p{number}" for number in range(3 * MAX_PROCESSES)]
    for name in names:
        desk.up(A, name)
    assert addressees(next_tick(desk), A) == names[-MAX_PROCESSES:]
    for name in names[1:]:
        desk.down(A, name)
    assert addressees(next_tick(desk), A) == names[:1]


def test_a_departed_vehicle_is_reported_to_the_process_with_its_agent(desk: Desk) -> None:
    desk.up(A, F)
    desk.drive(lambda: A not in desk.core.vehicles)
    desk.drive(lambda: desk.core.phase is TickPhase.SHUTTING_DOWN)
    assert any(sense.left for sense in sent(desk.effects, Sense) if sense.vehicle == A)
    assert set(addressees(desk.effects, A)) == {F}
    desk.up(A, G)
    desk.effects.clear()
    list(desk.core.road.caretakers.notify_departed(desk.core.tick))
    (notice, *_) = desk.core.road.caretakers.notify_departed(desk.core.tick)
    assert isinstance(notice, Send)
    assert notice.parameters["process"] == F
    desk.down(A, F)
    desk.down(A, G)
    assert A not in desk.core.road.caretakers.departed
    assert not desk.core.road.caretakers._processes
