"""Tables, goals and statements: they follow the data, and say what is missing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from attrs import evolve

from laneweave.launch.evaluation.agreement import Agreement
from laneweave.launch.evaluation.evidence import (
    Evidence,
    Picture,
    read_evidence,
    write_evidence,
)
from laneweave.launch.evaluation.goals import goals_table, meets
from laneweave.launch.evaluation.programme import LABELS, ROLLING_VOLUMES, planned
from laneweave.launch.evaluation.statements import PAPER_VOLUMES, statements_table
from laneweave.launch.evaluation.tables import document_parts
from laneweave.launch.evaluation.trials import AgreementRow, CostRow, FactorRow
from laneweave.protocol.errors import BadInputError
from unit.launch.evaluation.recorded import TRACED, evidence, point

DRIVER = Path(__file__).resolve().parents[4] / "benchmarks" / "evaluation.py"


def cells(table: str, first: str) -> list[str]:
    """Return the cells of the row that begins so."""
    (row,) = [line for line in table.splitlines() if line.startswith(f"| {first}")]
    return [cell.strip() for cell in row.strip("|").split("|")]


def full() -> Evidence:
    """Return evidence with every point, formation control at its goals, rules that congest."""
    times = {"rolling": 66.5, "paper-6": 67.4, "paper-12": 67.4, "lc2013": 67.5}
    rows = [
        point(label, volume, times.get(label, 45.0 + volume / 40.0))
        for label in LABELS
        for volume in ROLLING_VOLUMES
        if planned(label, volume)
    ]
    jam = evolve(TRACED, slow_m=(500.0, 800.0), slowest_mps=3.0)
    rows = [evolve(row, traced=jam) if row.label.startswith("rule") else row for row in rows]
    agreed = AgreementRow(1600.0, 1, 120.0, 0, 170, Agreement(160, 0, 0, 0, 0.0))
    return evolve(
        evidence(*rows),
        pictures=(Picture("evaluation-all.png", "boxes", "Travel times."),),
        agreements=(agreed,),
        factors=tuple(
            FactorRow(trial, "laneweave run", 1, 90, factor, 10.0, 20.0)
            for trial, factor in (("zenoh", 2.1), ("zenoh-50", 5.1), ("simulated", 5.9))
        ),
        costs=(
            CostRow("short", "laneweave run", 1000.0, 100, 0.2),
            CostRow("long", "laneweave run", 10_000.0, 1000, 0.22),
        ),
    )


def test_what_is_missing_says_so() -> None:
    parts = document_parts(Evidence())
    assert cells(parts["evaluation travel times"], "1600") == ["1600", *["missing"] * len(LABELS)]
    assert cells(parts["evaluation travel times"], "1800")[1:] == ["missing", *["-"] * 7]
    for name in ("lattice", "agreement", "factors", "costs"):
        assert "missing" in parts[f"evaluation {name}"]
    goals = parts["evaluation goals"].splitlines()[2:]
    assert all("missing" in line and line.endswith("|  |") for line in goals)
    statements = parts["evaluation statements"]
    assert "holds" not in statements
    assert "not hold" not in statements


def test_nothing_is_missing() -> None:
    for name, text in document_parts(full()).items():
        assert "missing" not in text, name


def test_cells() -> None:
    some = evolve(
        point("lc2013", 1000.0, 67.123),
        seeds=(1, 2),
        failed=((2, "1 pairs of vehicles overlapped"),),
        overlaps=1,
        emergency_brakes=8,
        on_preferred_lane=3998,
    )
    parts = document_parts(evidence(some))
    place = 1 + LABELS.index("lc2013")
    shown = {name: cells(parts[f"evaluation {name}"], "1000")[place] for name in (
        "runs", "travel times", "lanes", "margins", "brakes", "throughput"
    )}  # fmt: skip
    assert shown == {
        "runs": "2 of 5, 1 failed",
        "travel times": "67.12 (68.1)",
        "lanes": "99.950 % (2 off)",
        "margins": "9.80 / 0.86 / -6.8, **1 overlaps**",
        "brakes": "0.2",
        "throughput": "1000",
    }
    assert "Arrivals in each run: 600 s." in parts["evaluation runs"]


def test_a_point_whose_runs_all_failed() -> None:
    parts = document_parts(
        evidence(evolve(point("rule", 1000.0, 0.0), seeds=(), failed=((1, "x"),)))
    )
    assert cells(parts["evaluation travel times"], "1000")[1 + LABELS.index("rule")] == "failed"
    assert cells(parts["evaluation runs"], "1000")[1 + LABELS.index("rule")] == "0 of 5, 1 failed"


def test_goals() -> None:
    table = goals_table(full())
    assert cells(table, "`rolling`, 2400")[2:] == ["66.50 s, 100 %", "holds"]
    assert cells(table, "`paper-12`, 1600")[3] == "holds"
    assert cells(table, "spacing")[2:] == ["14.93 m, least of 440,000 in 110 runs", "holds"]
    assert cells(table, "real-time factor at 1600, one process, s")[2:] == ["5.90", "**missed**"]
    assert cells(table, "cost")[2:] == ["1.10 times", "holds"]
    assert cells(table, "three points")[3] == "holds"


@pytest.mark.parametrize(
    ("on_lane", "share_percent", "met"),
    [(4000, 100.0, True), (3999, 100.0, False), (3998, 99.95, True), (3997, 99.95, False)],
)
def test_shares_are_of_all_who_came(on_lane: int, share_percent: float, *, met: bool) -> None:
    row = evolve(point("rolling", 2200.0, 67.5), on_preferred_lane=on_lane)
    assert meets(row, 67.5, share_percent) is met
    assert not meets(row, 67.4, share_percent)
    assert not meets(evolve(row, travel_s=None), 67.5, share_percent)


def test_a_broken_promise_is_a_goal_missed() -> None:
    bad = evolve(
        point("rolling", 2400.0, 66.0, evolve(TRACED, lattice_least_m=14.2, lattice_kept=False)),
        overlaps=1,
        within_limits=False,
    )
    table = goals_table(evidence(point("paper-12", 1000.0, 67.0), bad))
    for goal in ("overlaps", "accelerations", "spacing"):
        assert cells(table, goal)[3] == "**missed**"


def test_statements_follow_the_data() -> None:
    table = statements_table(full())
    assert cells(table, "The travel time of formation control")[2] == "holds"
    # 45 s + volume / 40: congested, above 83.3 s, from 1600 on; faster than formations below 900.
    assert cells(table, "Severe congestion")[2] == "**does not hold**"
    assert "`rule` at 1600, not yet at 1450" in cells(table, "Severe congestion")[1]
    assert cells(table, "The congestion is at")[2] == "holds"
    assert cells(table, "Formation control is faster")[2] == "holds"
    assert cells(table, "At most 1800")[2] == "holds"


def test_readings_of_the_rules_may_differ() -> None:
    rows = [point("paper-6", volume, 68.0) for volume in PAPER_VOLUMES]
    rows += [point("rule", volume, 67.0) for volume in PAPER_VOLUMES]
    rows += [point("rule-net", volume, 200.0) for volume in PAPER_VOLUMES]
    table = statements_table(evidence(*rows))
    assert cells(table, "The rules bring")[2] == "so far: holds"
    assert "seeds yet" not in table
    assert "5 seeds yet" in statements_table(evidence(evolve(rows[0], seeds=(1,))))
    for statement in ("Severe congestion", "Formation control is faster"):
        assert cells(table, statement)[2] == "so far: depends on the reading"
    assert "`rule` minus `paper-6` -1.0, -1.0, -1.0, -1.0, -1.0 s" in table


def test_evidence_is_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "evaluation.json"
    assert read_evidence(path) == Evidence()
    write_evidence(full(), path)
    assert read_evidence(path) == full()
    path.write_text(json.dumps({"schema": "laneweave.evaluation/1", "speed": 1}))
    with pytest.raises(BadInputError, match="speed"):
        read_evidence(path)


def test_parts_that_are_not_there_anew_stay() -> None:
    old = full()
    new = Evidence(factors=old.factors[:1])
    assert old.renewed(new) == evolve(old, factors=old.factors[:1])
    points = evidence(point("rule", 1000.0, 70.0))
    renewed = old.renewed(points)
    assert (renewed.points, renewed.pictures) == (points.points, ())
    assert renewed.costs == old.costs


@pytest.mark.parametrize(
    "options",
    [
        ("--only", "everything"),
        ("--seeds", "5:1"),
        ("--budget", "soon"),
        ("--duration", "-3"),
        ("--jobs", "0"),
        ("--only", "report", "--sweeps", "nowhere"),
    ],
)
def test_bad_options_are_refused_in_one_line(options: tuple[str, ...], tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, DRIVER, "--out", tmp_path, *options],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert options[-2] in done.stderr
    assert done.stderr.splitlines()[-1].count("allowed: ") == 1
    assert not list(tmp_path.iterdir())
