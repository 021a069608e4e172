"""Formations that change on their way: structures one after the other, and one that takes in more.

Real roles on the simulated network, without SUMO.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from attrs import asdict

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.core import TickPhase
from laneweave.sim_bridge.road.demand import Arrival
from support.bridge_bench import Street, arrival, read_summary
from support.paper import EXACT

pytestmark = pytest.mark.slow

BEFORE_STAGE_S = 40.2
"""Just before the second structure is planned, 5 s before the rear passes its beginning."""
LOOK_S = 0.5
"""How long before a change the cells are looked at."""


Cells = dict[float, dict[str, Cell]]
"""The cells of all vehicles by road time [s]."""


def drive(
    scenario: Scenario,
    folder: Path,
    arrivals: tuple[Arrival, ...],
    leader_hangs_s: float | None = None,
) -> tuple[list[dict[str, Any]], Cells]:
    """Drive a demand to its end; return the events and the cells of all vehicles."""
    street = Street(scenario, folder, arrivals)
    candidates = {name: street.start_coordinator(name, 1) for name in ("c0", "c1")}
    street.start_shard()
    if leader_hangs_s is not None:
        street.run(lambda: street.bridge.t_s >= leader_hangs_s)
        (leader,) = (name for name, core in candidates.items() if core.election.leading)
        street.network.pause(leader)
    cells: Cells = {}

    def ended() -> bool:
        bridge = street.bridge
        cells[round(bridge.t_s, 1)] = {str(n): v.cell for n, v in bridge.vehicles.items()}
        return bridge.phase is TickPhase.ENDED

    street.run(ended)
    summary = read_summary(folder)
    assert summary["safety"]["overlaps"] == 0
    assert summary["vehicles"]["on_preferred_lane"] == summary["vehicles"]["demanded"]
    lines = (folder / "events.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines], cells


def before(cells: Cells, plan: dict[str, Any]) -> dict[str, Cell]:
    """Return the cells shortly before a plan begins."""
    return cells[min(cells, key=lambda t_s: abs(t_s - (plan["t0_s"] - LOOK_S)))]


def of_kind(events: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [event for event in events if event["kind"] == kind]


@pytest.mark.more
@pytest.mark.parametrize("leader_hangs", [False, True])
def test_a_formation_takes_on_one_structure_after_the_other(
    tmp_path: Path, leader_hangs: bool
) -> None:
    """Also if the leader hangs when the next stage begins: the new one adopts the last plan."""
    scenario = parse_scenario(
        {
            "road": {"lanes": 3, "s1_m": 50.0, "s2_m": 950.0, "s3_m": 400.0},
            "sensing": asdict(EXACT),
            "formation": {
                "structures": [
                    {"from_m": 200.0, "structure": "interlaced"},
                    {"from_m": 600.0, "structure": "parallel", "lanes": [0, 1]},
                ]
            },
        }
    )
    arrivals = tuple(arrival(f"v{n}", 1.0 + 0.8 * n, n % 3, (n + 1) % 3) for n in range(6))
    events, cells = drive(scenario, tmp_path, arrivals, BEFORE_STAGE_S if leader_hangs else None)
    plans = of_kind(events, "plan-made")
    assert [plan["vehicles"] for plan in plans] == [6, 6, 6]
    assert {plan["solver"] for plan in plans} == {"branching"}
    assert [plan["name"] == plans[0]["name"] for plan in plans[1:]] == 2 * [not leader_hangs]

    interlaced = before(cells, plans[1])
    assert len({(column + lane) % 2 for column, lane in interlaced.values()}) == 1
    parallel = before(cells, plans[2])
    assert {lane for _, lane in parallel.values()} == {0, 1}
    for wanted in (0, 1):
        columns = sorted(column for column, lane in parallel.values() if lane == wanted)
        assert columns == list(range(columns[0], columns[0] + len(columns)))


def joining(join: str) -> Scenario:
    return parse_scenario(
        {
            "road": {"lanes": 3, "s1_m": 50.0, "s2_m": 450.0, "s3_m": 500.0},
            "sensing": asdict(EXACT),
            "formation": {
                "max_columns": 3,
                "max_joined": 2,
                "join": join,
                "structures": [{"from_m": 250.0, "structure": "interlaced"}],
            },
        }
    )


LATECOMER = (
    arrival("v1", 1.0, 0, 0),
    arrival("v2", 1.0, 2, 2),
    arrival("v3", 2.0, 1, 1),
    arrival("v4", 2.1, 2, 2),
    arrival("v5", 3.2, 1, 0),
)
"""Four of a formation, and one that comes when it is closed (paper, Fig. 2b)."""


@pytest.mark.more
def test_a_vehicle_joins_a_formation_that_has_room(tmp_path: Path) -> None:
    scenario = joining("room")
    events, cells = drive(scenario, tmp_path, LATECOMER)
    assert [len(event["vehicles"]) for event in of_kind(events, "formation-closed")] == [4, 1]
    (joined,) = of_kind(events, "formations-joined")
    assert joined["why"] == "room"
    sorting = of_kind(events, "plan-made")[-1]
    assert sorting["vehicles"] == 5
    together = before(cells, sorting)
    assert len(together) == 5
    assert len({(column + lane) % 2 for column, lane in together.values()}) == 1
    columns = [column for column, _ in together.values()]
    assert max(columns) - min(columns) < 4


@pytest.mark.more
def test_without_need_formations_stay_apart_unless_they_may_join(tmp_path: Path) -> None:
    events, _ = drive(joining("needed"), tmp_path, LATECOMER)
    assert of_kind(events, "formations-joined") == []
    assert {plan["vehicles"] for plan in of_kind(events, "plan-made")} == {4, 1}
