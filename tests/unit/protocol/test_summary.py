"""summary.json: what is written and read."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from attrs import evolve

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.summary import RunSummary, described, read_summary, write_summary
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


def test_every_field_is_described() -> None:
    found = {path: (unit, meaning) for path, unit, meaning in described()}
    assert all(meaning for _, meaning in found.values())
    assert found["travel_time_s.by_type.*.delay"][0] == "s"
    assert found["planning.solve_ms.p95"] == ("ms", "time to make a plan: 95th percentile")

    def leaves(tables: dict[str, Any], prefix: str = "") -> Iterator[str]:
        for key, value in tables.items():
            if isinstance(value, dict):
                yield from leaves(value, f"{prefix}{key}.")
            else:
                yield f"{prefix}{key}"

    assert set(leaves(make_summary().to_json())) <= found.keys()
    units = {"s": "s", "m": "m", "mps2": "m/s2", "mps3": "m/s3", "veh_per_lane_h": "veh/(lane h)"}
    for path, (unit, _) in found.items():
        expected = next((own for end, own in units.items() if path.endswith(f"_{end}")), unit)
        assert unit == expected, path


def test_on_a_full_disk_a_summary_takes_the_place_of_an_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    write_summary(tmp_path, make_summary(seed=10_000))
    monkeypatch.setattr("laneweave.protocol.summary.write_atomically", full)
    write_summary(tmp_path, make_summary(seed=2))
    summary = read_summary(tmp_path)
    assert summary is not None
    assert summary.seed == 2
    with pytest.raises(OSError, match="No such file"):
        write_summary(tmp_path / "gone", make_summary())
