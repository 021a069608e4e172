"""summary.json: what is written and read."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from attrs import evolve

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.summary import RunSummary, read_summary, write_summary
from support.summaries import make_summary


def test_a_summary_is_written_atomically(tmp_path: Path) -> None:
    write_summary(tmp_path, make_summary(seed=1))
    with pytest.raises(ValueError, match="JSON"):
        write_summary(tmp_path, evolve(make_summary(), road_m=float("nan")))
    assert read_summary(tmp_path) == make_summary(seed=1)
    write_summary(tmp_path, make_summary(seed=2))
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]


def test_fields_that_earlier_versions_did_not_write_are_not_added() -> None:
    older = make_summary()
    data = older.to_json()
    assert "by_solver" not in data["planning"]
    assert "faults" not in data
    assert data["travel_time_s"].keys() == {"mean", "p50", "p95", "max"}
    newer = make_summary(planning={"by_solver": {"tappa": 1}, "fallbacks": 0}, faults={"x": 1})
    assert list(newer.to_json()["planning"]) == [
        "plans", "optimal", "largest_formation", "by_solver", "fallbacks", "solve_ms",
    ]  # fmt: skip
    assert RunSummary.from_json(json.loads(json.dumps(newer.to_json()))) == newer


@pytest.mark.parametrize("text", ["{}", "[]", '{"schema"', ""])
def test_an_incomplete_summary_is_none(tmp_path: Path, text: str) -> None:
    (tmp_path / "summary.json").write_text(text, encoding="utf-8")
    assert read_summary(tmp_path) is None


def test_a_missing_summary_is_none(tmp_path: Path) -> None:
    assert read_summary(tmp_path) is None
    with pytest.raises(BadInputError, match=r"summary\.json"):
        RunSummary.from_json({"schema": "laneweave.summary/1"})
