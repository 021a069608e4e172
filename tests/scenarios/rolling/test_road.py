"""Under random faults no cell has two owners, and leaders never conclude wrong owners."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from laneweave.coordinator.rolling import ownership
from laneweave.coordinator.rolling.ownership import _Sign, owned_cells
from laneweave.protocol.state_machine import Function, RuleBook
from laneweave.protocol.vehicle.plan_execution import VEHICLE_RULES, all_are_ready, open_transfer
from laneweave.protocol.wire.messages import Ballot, PendingTransfer, VehicleState
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from support.broken_cell_ownership import cancel_closed_transfers, forget_promise
from support.rolling_road import Road, WrongError
from support.rule_books import replacing

STEPS = 600
SEEDS = range(300)
"""In which each planted bug is found."""


def first_wrong(rules: RuleBook = VEHICLE_RULES) -> int | None:
    for seed in SEEDS:
        try:
            Road(Random(seed), rules).run(STEPS)
        except WrongError:
            return seed
    return None


@given(st.integers(0, 2**32))
@settings(max_examples=60, deadline=None)
def test_no_cell_has_two_owners_and_vehicles_own_where_they_are(seed: int) -> None:
    Road(Random(seed)).run(STEPS)


def test_the_random_roads_move_vehicles_and_open_gates() -> None:
    roads = [Road(Random(seed)) for seed in range(100)]
    for road in roads:
        road.run(STEPS)
    assert sum(road.moves for road in roads) > 200
    assert sum(len(road.opened) for road in roads) > 200


def test_leaders_never_conclude_wrong_owned_cells() -> None:
    """However old its states of the others; and it usually concludes all owned cells."""
    told = told_in_part = not_told = 0
    for seed in range(60):
        road = Road(Random(1000 + seed))
        for _ in range(STEPS // 5):
            road.run(5)
            for leader in road.leaders:
                for car in road.cars.values():
                    transfer, state = car.controller.transfer, car.state_now()
                    if not state.owned:
                        continue  # a promise that its controller has not noted
                    cells = owned_cells(state, leader.states)
                    if cells is None:
                        not_told += 1
                    elif cells == road.owned(car):
                        told += 1
                    else:
                        assert transfer is not None
                        assert cells == set(transfer.before) & set(transfer.after)
                        assert cells <= road.owned(car)
                        told_in_part += 1
                    assert cells is not None or (transfer is not None and not transfer.open)
    assert told > 10 * told_in_part > 0
    assert told > not_told > 0


# --- planted bugs ---------------------------------------------------------------------


def forget_all_promises(patch: pytest.MonkeyPatch) -> None:
    """A promise does not bind the next process, and plans are accepted without transfers."""

    def accept(self: MotionController, ballot: Ballot) -> None:
        self.accepted = ballot if self.accepted is None else max(self.accepted, ballot)

    forget_promise(patch)
    patch.setattr(MotionController, "store_acceptance", accept)


def newer_counts_as_closed(patch: pytest.MonkeyPatch) -> None:
    """A vehicle with a newer transfer counts as one whose gate stayed closed."""
    sign = ownership._sign

    def mutant(state: VehicleState | None, transfer: PendingTransfer) -> _Sign:
        found = sign(state, transfer)
        return _Sign.CLOSED if found is _Sign.NEWER else found

    patch.setattr(ownership, "_sign", mutant)


@pytest.mark.parametrize(
    "plant", [forget_all_promises, newer_counts_as_closed, cancel_closed_transfers]
)
def test_a_planted_bug_is_found(plant: object, monkeypatch: pytest.MonkeyPatch) -> None:
    assert callable(plant)
    plant(monkeypatch)
    assert first_wrong() is not None


@pytest.mark.parametrize("rule", [all_are_ready, open_transfer], ids=lambda rule: rule.__name__)
def test_a_broken_rule_is_found(rule: Function) -> None:
    assert first_wrong(replacing(VEHICLE_RULES, {rule: lambda *_: True})) is not None
