"""A whole run in the rolling operation: real roles on a bad simulated network, and no SUMO."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from laneweave.protocol.lattice import Cell
from laneweave.protocol.transports.simulated.virtual_time import Conditions
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.core import TickPhase
from laneweave.sim_bridge.road.demand import Arrival
from support.bridge_bench import Street, make_scenario, read_summary

SCENARIO = make_scenario(
    formation={"operation": "rolling"},
    road={"lanes": 2, "s1_m": 20.0, "s2_m": 160.0, "s3_m": 320.0},
)
DEMAND = tuple(
    Arrival(f"v{number}", number % 2, 1 - number % 2, 1.3 + 1.7 * number) for number in range(6)
)
"""Everybody wants the other lane."""
BAD = Conditions(jitter_s=0.05, loss=0.2, duplication=0.1)


def watched(street: Street) -> Callable[[], bool]:
    """Return when to stop; before, check that no cell has two owners at any time."""
    opened = set()

    def look() -> bool:
        owners: dict[Cell, Name] = {}
        controllers = {name: each.controller for name, each in street.bridge.vehicles.items()}
        for controller in controllers.values():
            if controller.record.transfer is not None and controller.record.transfer.open:
                opened.add(controller.record.transfer.ballot)
        for name, controller in controllers.items():
            transfer, cells = controller.record.transfer, set(controller.record.owned)
            if transfer is not None and not transfer.open and transfer.ballot in opened:
                cells = set(transfer.after)
            assert controller.hold_cell in cells
            for cell in cells:
                assert cell not in owners, f"{cell} is of {owners[cell]} and of {name}"
                owners[cell] = name
        return street.bridge.phase is TickPhase.ENDED

    return look


@pytest.mark.more
def test_on_a_bad_network_vehicles_are_late_at_worst(tmp_path: Path) -> None:
    street = Street(SCENARIO, tmp_path, DEMAND, BAD)
    street.start_coordinators(2)
    street.start_shard()
    street.run(watched(street))
    summary = read_summary(tmp_path)
    assert summary["ending"] == "complete"
    assert summary["vehicles"]["left"] == len(DEMAND)
    assert summary["safety"]["overlaps"] == 0
