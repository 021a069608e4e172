"""The checker of the rolling operation notices two owners, strangers, and moves without a gate."""

from __future__ import annotations

import pytest

from laneweave.launch.fault_search.checks.cell_ownership import CellOwnership
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Ballot, Name, PendingTransfer

HERE, THERE, BEYOND = (0, 0), (0, 1), (0, 2)
BALLOT = Ballot(1, Name("c1"), 1, 1)
ROSTER = (Name("a"), Name("b"))
OPEN = PendingTransfer(BALLOT, open=True)


class Watched:
    """Cell ownership, and the kinds of violations that it reports."""

    def __init__(self) -> None:
        """Begin without vehicles."""
        self.kinds: list[str] = []
        self.ownership = CellOwnership(self._tell)

    def _tell(self, kind: str, t_s: float, vehicles: list[str], text: str) -> None:
        del t_s, vehicles, text
        self.kinds.append(kind)

    def show(self, vehicle: str, *owned: Cell, transfer: PendingTransfer | None = None) -> None:
        self.ownership.update(0.0, vehicle, owned, transfer)

    def stand(self, vehicle: str, *cells: Cell) -> None:
        self.ownership.occupy(0.0, vehicle, frozenset(cells))


@pytest.fixture
def watched() -> Watched:
    """A owns HERE, B owns THERE and BEYOND and is in the latter."""
    watched = Watched()
    watched.show("a", HERE)
    watched.show("b", THERE, BEYOND)
    watched.stand("a", HERE)
    watched.stand("b", BEYOND)
    return watched


def shut(before: tuple[Cell, ...], after: tuple[Cell, ...]) -> PendingTransfer:
    return PendingTransfer(BALLOT, before, after, ROSTER)


def hand_over(watched: Watched) -> None:
    """Both accept that THERE becomes A's; A opens its gate."""
    watched.show("a", HERE, transfer=shut((HERE,), (HERE, THERE)))
    watched.show("b", THERE, BEYOND, transfer=shut((THERE, BEYOND), (BEYOND,)))
    watched.show("a", HERE, THERE, transfer=OPEN)


def test_while_gates_open_a_cell_is_of_whom_the_plan_gives_it(watched: Watched) -> None:
    hand_over(watched)
    assert watched.kinds == []
    watched.stand("b", THERE)  # its controller believes that it owns it still
    assert watched.kinds == ["trespass"]


def test_a_cell_has_one_owner(watched: Watched) -> None:
    hand_over(watched)
    watched.show("b", THERE, BEYOND, transfer=PendingTransfer(BALLOT._replace(seq=2), open=True))
    assert watched.kinds == ["owner"]


def test_possession_without_a_transfer_is_seen(watched: Watched) -> None:
    watched.show("a", HERE, THERE)
    assert watched.kinds == ["owner"]


def test_a_body_stays_in_its_own_cells(watched: Watched) -> None:
    watched.stand("a", HERE, (1, 0))
    watched.show("b", THERE)
    assert watched.kinds == ["trespass", "trespass"]


def test_a_move_before_possession_is_seen(watched: Watched) -> None:
    watched.ownership.move(0.0, "a", BALLOT)
    assert watched.kinds == ["gate"]
    hand_over(watched)
    watched.ownership.move(0.0, "a", BALLOT)
    assert watched.kinds == ["gate"]


def test_the_cells_of_a_vehicle_that_leaves_are_free(watched: Watched) -> None:
    watched.ownership.leave("b")
    watched.show("a", HERE, THERE)
    assert watched.kinds == []
