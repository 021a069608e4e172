"""Random search for settings: what is drawn, how sets are compared, what is refused."""

from __future__ import annotations

import errno
import json
import math
import os
import random
from pathlib import Path
from unittest.mock import Mock

import pytest
from attrs import evolve

from laneweave.launch.recordings.runs import Run
from laneweave.launch.run_methods import METHODS
from laneweave.launch.studies.tuning import (
    DEFAULT_SET,
    MAX_BUDGET,
    OTHER_LANE_S,
    RANGES,
    Range,
    draw_sets,
    ranges_of,
    score_of,
)
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.summary import RunSummary
from support.commands import Here
from support.summaries import make_summary

BASE = load_scenario(None, demand__duration_s=20.0, road__s3_m=300.0, road__s2_m=50.0)


def run_with(seed: int, summary: RunSummary | None, method: str = "lc2013") -> Run:
    return Run(Path("x"), "set-0001", method, evolve(BASE, seed=seed), summary)


def summary_with(
    mean_s: float | None, *, in_lane: int = 100, left: int = 100, overlaps: int = 0
) -> RunSummary:
    made = make_summary(seed=1)
    return evolve(
        made,
        vehicles=evolve(
            made.vehicles, demanded=100, entered=100, left=left, on_preferred_lane=in_lane,
            at_destination=in_lane,
        ),
        travel_time_s=evolve(made.travel_time_s, mean=mean_s),
        safety=evolve(made.safety, overlaps=overlaps, hard_brakes=3, min_ttc_s=2.5),
    )  # fmt: skip


def test_sets_lie_within_the_ranges_and_the_first_one_is_the_methods_own() -> None:
    ranges = ranges_of("lc2013", (), BASE)
    sets = draw_sets("lc2013", ranges, BASE, 30)
    assert sets == draw_sets("lc2013", ranges, BASE, 30)
    assert sets[DEFAULT_SET] == METHODS["lc2013"]
    assert [*sets][:3] == [DEFAULT_SET, "set-0001", "set-0002"]
    drawn = [one.overrides for label, one in sets.items() if label != DEFAULT_SET]
    assert len(drawn) == 29
    for values in drawn:
        assert values.keys() == RANGES["lc2013"].keys()
        for name, one in ranges.items():
            value = values[name]
            assert isinstance(value, float)
            assert one.low <= value <= one.high
    spread = [float(str(values["lc2013.strategic"])) for values in drawn]
    assert sum(value < math.sqrt(0.3 * 100.0) for value in spread) == pytest.approx(15, abs=8)
    others = draw_sets("lc2013", ranges, evolve(BASE, seed=2), 2)
    assert others["set-0001"] != sets["set-0001"]


def test_a_larger_budget_adds_sets() -> None:
    ranges = ranges_of("lc2013", (), BASE)
    few, many = (draw_sets("lc2013", ranges, BASE, budget) for budget in (3, 12))
    assert few.items() < many.items()


def test_a_label_keeps_its_own_settings() -> None:
    sets = draw_sets("sl2015-human", ranges_of("sl2015-human", (), BASE), BASE, 2)
    drawn = sets["set-0001"].settings(BASE).lc2013
    assert (drawn.model, drawn.headway_s, drawn.imperfection) == ("SL2015", 1.0, 0.5)
    assert drawn.strategic == sets["set-0001"].overrides["lc2013.strategic"]


def test_ranges_that_are_given_replace_or_add() -> None:
    given = ("lc2013.headway_s=0.5:1", "lc2013.assertive=1:1")
    ranges = ranges_of("lc2013", given, BASE)
    assert ranges["lc2013.headway_s"] == Range(0.5, 1.0)
    assert ranges["lc2013.assertive"] == Range(1.0, 1.0)
    assert ranges["lc2013.min_gap_m"] == RANGES["lc2013"]["lc2013.min_gap_m"]
    members = ranges_of("formation", ("formation.max_vehicles=4:7",), BASE)
    assert members == {"formation.max_vehicles": Range(4.0, 7.0, whole=True)}
    drawn = {members["formation.max_vehicles"].draw(random.Random(seed)) for seed in range(50)}
    assert drawn == {4, 5, 6, 7}


@pytest.mark.parametrize(
    ("field", "whole"),
    [
        ("tracking.horizon_ticks=70:100", True),
        ("formation.weight_oblique=1:2", True),
        ("formation.cycle_s=5:7", False),
        ("formation.gap_m=14:16", False),
    ],
)
def test_fields_without_a_value_have_ranges_of_their_type(field: str, *, whole: bool) -> None:
    (found,) = ranges_of("formation", (field,), BASE).values()
    assert found.whole == whole
    assert len(draw_sets("formation", {field.partition("=")[0]: found}, BASE, 5)) == 5


@pytest.mark.parametrize(
    ("method", "range_", "problem"),
    [
        ("formation", (), "at least one range"),
        ("lc2013", ("lc2013.assertive",), "TABLE.FIELD=LOW:HIGH"),
        ("lc2013", ("lc2013.assertive=1",), "two numbers"),
        ("lc2013", ("lc2013.assertive=2:1",), "LOW <= HIGH"),
        ("lc2013", ("lc2013.assertive=nan:1",), "LOW <= HIGH"),
        ("lc2013", ("lc2013.assertive=1:inf",), "LOW <= HIGH"),
        ("lc2013", ("lc2013.model=1:2",), "a field with one number"),
        ("lc2013", ("lc2013.nothing=1:2",), "a field of scenario files"),
        ("lc2013", ("seed=1:2",), "a field of scenario files"),
        ("lc2013", ("lattice.pitch_m=1:2",), "a field of scenario files"),
        ("lc2013", ("road.length_m=1:2",), "a field of scenario files"),
        ("lc2013", ("road.s3_m=300:900",), "all sets share"),
        ("formation", ("road.lanes=2:4",), "all sets share"),
        ("formation", ("demand.min_headway_s=0.5:2",), "all sets share"),
        ("formation", ("sensing.gap_noise_m=0:1",), "all sets share"),
        ("lc2013", ("demand.duration_s=100:200",), "all sets share"),
        ("lc2013", ("demand.volume_veh_per_lane_h=800:900",), "all sets share"),
        ("lc2013", ("formation.max_columns=1:3",), "affects how lc2013 drives"),
        ("formation", ("tracking.shortcut=0:1",), "a field with one number"),
        ("formation", ("formation.max_vehicles=4.2:4.8",), "a whole number"),
    ],
)
def test_ranges_that_are_refused(method: str, range_: tuple[str, ...], problem: str) -> None:
    with pytest.raises(BadInputError, match=problem):
        ranges_of(method, range_, BASE)


@pytest.mark.parametrize("budget", [0, 1, MAX_BUDGET + 1])
def test_a_budget_that_is_refused(budget: int) -> None:
    with pytest.raises(BadInputError, match="--budget"):
        draw_sets("lc2013", ranges_of("lc2013", (), BASE), BASE, budget)


def test_ranges_without_an_allowed_set_are_refused_with_the_reason() -> None:
    with pytest.raises(BadInputError, match=r"got 'formation.gap_m=1:2'.*\(formation\.gap_m"):
        draw_sets("formation", ranges_of("formation", ("formation.gap_m=1:2",), BASE), BASE, 2)


def test_scores() -> None:
    runs = [run_with(1, summary_with(70.0)), run_with(2, summary_with(72.0, in_lane=97))]
    score = score_of("set-0001", runs)
    assert score.score_s == pytest.approx(71.0 + 1.5 * OTHER_LANE_S)
    assert (score.travel_time_s, score.arrived_percent) == (71.0, 98.5)
    assert (score.hard_brakes, score.min_ttc_s, score.failed) == (6, 2.5, 0)


@pytest.mark.parametrize(
    "summary",
    [None, summary_with(None), summary_with(70.0, left=99)],
    ids=["failed", "no travel time", "stuck"],
)
def test_a_set_with_a_bad_run_is_not_eligible(summary: RunSummary | None) -> None:
    score = score_of("set-0001", [run_with(1, summary_with(60.0)), run_with(2, summary)])
    assert math.isinf(score.score_s)


def test_on_a_corridor_vehicles_may_stay_outside() -> None:
    corridor = evolve(BASE, sumo=evolve(BASE.sumo, config="x.sumocfg"))
    outside = summary_with(70.0, left=99)
    outside = evolve(outside, vehicles=evolve(outside.vehicles, entered=99))
    for scenario, summary, eligible in (
        (corridor, outside, True), (corridor, summary_with(70.0, left=99), False),
        (BASE, outside, False),
    ):  # fmt: skip
        run = evolve(run_with(1, summary), scenario=scenario)
        assert math.isfinite(score_of("set-0001", [run]).score_s) is eligible


@pytest.mark.parametrize(("method", "eligible"), [("lc2013", True), ("formation", False)])
def test_overlaps_exclude_formation_control_only(method: str, *, eligible: bool) -> None:
    run = run_with(1, summary_with(60.0, overlaps=1), method)
    score = score_of("set-0001", [evolve(run, reason="1 pair of vehicles overlapped")])
    assert (math.isfinite(score.score_s), score.overlaps) == (eligible, 1)


def test_the_command_finds_prints_and_continues(laneweave: Here, tmp_path: Path) -> None:
    command = (
        "tune", "sl2015", "--volumes", "900", "--budget", "2", "--seeds", "7:8", "--duration", "70",
        "--range", "lc2013.strategic=1:50", "--out", tmp_path / "found", "--jobs", "1",
    )  # fmt: skip
    status, out, errors = laneweave(*command)
    assert status == 0, errors
    found = json.loads((tmp_path / "found" / "tuning.json").read_text(encoding="utf-8"))
    assert found["schema"] == "laneweave.tuning/1"
    assert (found["seeds"], found["volumes_veh_per_lane_h"]) == ([7], [900.0])
    assert [one["label"] for one in found["sets"]] in (
        ["default", "set-0001"],
        ["set-0001", "default"],
    )
    assert found["sets"][0]["score_s"] <= found["sets"][1]["score_s"]
    assert f"best: {found['sets'][0]['label']}" in out
    _, _, errors = laneweave(*command)
    assert "2 of 2 runs were already finished" in errors[0]
    assert "a new folder" in laneweave.refused(*command, "--range", "lc2013.strategic=1:60")
    more = [*command[:5], "3", *command[6:]]
    _, _, errors = laneweave(*more)
    assert "2 of 3 runs were already finished" in errors[0]
    status, _, _ = laneweave(*command)  # those of a larger budget stay
    assert status == 0
    full = os.strerror(errno.ENOSPC)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Path, "replace", Mock(side_effect=OSError(errno.ENOSPC, full)))
        status, _, errors = laneweave(*command)
    assert (status, Path(errors[-1]).parent) == (1, tmp_path / "found")
    assert errors[-1].endswith(f": {full}")
    others = *command, "--seeds", "8:9", "--duration", "80"
    assert laneweave.refused(*others).startswith("--out")
    other = "sensitivity", "--method", "rule", "--out", tmp_path / "found"
    assert laneweave.refused(*other).startswith("--out")
    assert laneweave.refused("tune", "lc2014").startswith("METHOD: got 'lc2014'")
    assert laneweave.refused("tune", "rule", "--duration", "60").startswith("demand.duration_s")
