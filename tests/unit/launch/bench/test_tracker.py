"""`laneweave bench tracker`."""

from __future__ import annotations

import json

import pytest

from laneweave.agents.driving.tracker import Tracker
from laneweave.launch.bench.tracker import SITUATIONS, bench_tracker, drive, tracker_table
from laneweave.protocol.scenario.fields import Scenario
from support.commands import Here

SCENARIO = Scenario()


def test_every_situation_gets_a_row() -> None:
    rows = bench_tracker(SCENARIO, instances=1, seed=3, repeats=1)
    assert [row["situation"] for row in rows] == list(SITUATIONS)
    for row in rows:
        assert row["ticks"] > 10
        assert 0 < row["cpu_ms"]["p50"] <= row["cpu_ms"]["p99"] <= row["cpu_ms"]["max"]
        assert row["unusable"] == 0
    assert rows[0]["osqp_ticks"] > rows[-1]["osqp_ticks"]
    assert tracker_table(rows).row_count == len(rows)


def test_episodes_repeat() -> None:
    for name in SITUATIONS:
        first, again = (
            list(drive(Tracker(SCENARIO, SCENARIO.vehicle), SCENARIO, name, "3")) for _ in range(2)
        )
        assert [tick.state for tick in first] == [tick.state for tick in again]
        jerks = [[tick.result.jerk.tobytes() for tick in ticks] for ticks in (first, again)]
        assert jerks[0] == jerks[1]


@pytest.mark.slow
def test_json_has_a_result_for_each_situation(laneweave: Here) -> None:
    _, out, _ = laneweave("bench", "tracker", "--instances", 1, "--seed", 3, "--json")
    shown = json.loads(out)
    assert shown["benchmark"] == "tracker"
    assert len(shown["results"]) == len(SITUATIONS)
