"""Sensitivity of results to single settings: factors, their order, the page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from attrs import evolve

from laneweave.launch.recordings.runs import Run
from laneweave.launch.run_methods import LabelledMethod
from laneweave.launch.studies.sensitivity import (
    Factor,
    Level,
    Result,
    by_effect,
    factors_of,
    result_of,
)
from laneweave.launch.studies.sensitivity_page import draw_tornado, result_row, results_table
from laneweave.protocol.config.scenario_files import load_scenario, scenario_of
from laneweave.protocol.scenario.radio_table import C_V2X, DSRC
from laneweave.protocol.summary import Ending, TripTimes
from support.commands import Here
from support.summaries import make_summary

BASE = load_scenario(None)


def names(method: str, **overrides: object) -> list[str]:
    return [factor.name for factor in factors_of(method, load_scenario(None, **overrides))]


def level(factor: str, end: str, **overrides: object) -> Level:
    (found,) = (
        one
        for one in factors_of("formation", load_scenario(None, **overrides))
        if one.name == factor
    )
    chosen = found.low if end == "low" else found.high
    assert chosen is not None
    return chosen


def result(delay_s: float | None) -> Result:
    delays_s = () if delay_s is None else (delay_s - 0.1, delay_s + 0.1)
    return Result(2, delay_s, delays_s, 100.0, 3.2, 9.0, 130.0, 0, 0)


def test_all_factors_of_formations() -> None:
    assert names("formation") == [
        "preferred lanes", "volume", "length of S3", "v_F", "T_F", "N", "measurement errors",
        "radio", "delay", "loss",
    ]  # fmt: skip


def test_factors_without_effect_are_left_out() -> None:
    assert names("lc2013") == ["preferred lanes", "volume", "length of S3", "v_F"]
    assert "N" not in names("rolling")
    assert "N" in names("formations", formation__operation="rolling")
    assert "radio" not in names("formation", radio__technology=DSRC)


def test_levels_change_one_setting_of_the_method() -> None:
    assert level("volume", "high").method.overrides == {"demand.volume_veh_per_lane_h": 1200.0}
    assert level("v_F", "low").method.overrides == {"formation.speed_mps": 13.5}
    assert level("N", "low").method.overrides == {"formation.max_vehicles": 4}
    shares = level("preferred lanes", "low").method.overrides["demand.lane_shares"]
    assert shares == pytest.approx([0.6, 0.2, 0.2])
    rolling = {"formation__operation": "rolling"}
    errors = level("measurement errors", "high", **rolling).method.overrides
    assert errors["sensing.gap_noise_m"] == 1.5 * BASE.sensing.gap_noise_m
    (members,) = (one for one in factors_of("paper-18", BASE) if one.name == "N")
    assert [one.text for one in members.levels] == ["16", "20"]


def test_delay_and_loss_are_added_to_those_of_the_radio() -> None:
    lossy = level("loss", "high").method.settings(BASE).radio
    assert (lossy.technology, lossy.cellular_loss, lossy.burst_share) == (C_V2X, 0.31, 0.32)
    kept = level("delay", "high", radio__technology=DSRC, radio__cellular_delay_s=2.0)
    assert kept.method.overrides == {"radio.cellular_delay_s": 2.5}
    worse = level("loss", "high", radio__technology=DSRC, radio__cellular_loss=0.95)
    assert worse.method.overrides == {"radio.cellular_loss": 0.95, "radio.burst_share": 0.32}
    assert worse.text == "95 %, and in bursts for 32 % of the time"
    lost = {"radio__cellular_loss": 0.95, "radio__burst_share": 0.9}
    assert "loss" not in names("formation", radio__technology=DSRC, **lost)


def test_ends_that_are_impossible_are_named() -> None:
    short = scenario_of({"road": {"s3_m": 160.0}})
    found = {factor.name: factor for factor in factors_of("formation", short)}["length of S3"]
    assert found.low is None
    assert found.high is not None
    (reason,) = found.refused
    assert reason.startswith("length of S3 106.7 m: road.s3_m: got 106.7")


def test_results_of_runs() -> None:
    def run_with(
        delays_s: Sequence[float], ttc_s: float, left: int, ending: Ending = Ending.COMPLETE
    ) -> Run:
        made = make_summary()
        by_entrance = {
            name: TripTimes(n=n, mean=40.0 + delay_s, delay=delay_s)
            for name, n, delay_s in zip(("main", "ramp"), (30, 10), delays_s, strict=False)
        }
        summary = evolve(
            made,
            ending=ending.value,
            travel_time_s=evolve(made.travel_time_s, by_entrance=by_entrance),
            safety=evolve(made.safety, min_ttc_s=ttc_s),
            vehicles=evolve(made.vehicles, left=left),
        )
        reason = "" if ending is Ending.COMPLETE else "not complete"
        return Run(Path("x"), "base", "formation", BASE, summary, reason)

    runs = [
        run_with((3.0, 7.0), 3.1, 100),
        run_with((6.0,), 2.9, 100),
        run_with((), 3.0, 100),
        run_with((20.0,), 3.3, 98, Ending.LIMIT),
        Run(Path("x"), "base", "formation", BASE, None, "its process was ended by SIGKILL"),
    ]
    found = result_of(runs)
    assert (found.runs, found.failed) == (5, 2)
    assert result_row("N", "4", found)[-2:] == ("2", "5, 2 failed")
    assert found.delay_s == pytest.approx(5.0)
    assert found.delays_s == pytest.approx((4.0, 6.0))
    assert (found.min_ttc_s, found.not_left, found.co2_g_per_km) == (2.9, 2, None)
    assert result_of([]) == Result(0, None, (), None, None, None, None, 0, 0)


def test_factors_with_larger_effects_come_first_and_bars_reach_their_ends(tmp_path: Path) -> None:
    def factor(name: str, *ends: str | None) -> Factor:
        method = LabelledMethod("formation")
        low, high = (None if one is None else Level(one, one, method) for one in ends)
        return Factor(name, low, high)

    factors = [factor("small", "a", "b"), factor("large", None, "c"), factor("unknown", "d", None)]
    delays_s = {"base": 1.0, "a": 0.9, "b": 1.2, "c": 3.0, "d": None}
    results = {label: result(delay_s) for label, delay_s in delays_s.items()}
    ordered = by_effect(factors, results)
    assert [one.name for one in ordered] == ["large", "small", "unknown"]
    jammed = results | {"d": evolve(results["d"], failed=2)}
    assert [one.name for one in by_effect(factors, jammed)] == ["unknown", "large", "small"]
    draw_tornado(ordered, results, tmp_path / "chart.png")
    assert (tmp_path / "chart.png").read_bytes().startswith(b"\x89PNG")
    table = results_table(ordered, results)
    assert [row[:3] for row in table.rows] == [
        ("base", "", "1.00"), ("large", "c", "3.00"), ("small", "a", "0.90"),
        ("small", "b", "1.20"), ("unknown", "d", "-"),
    ]  # fmt: skip


def test_the_command_writes_a_page_and_continues(laneweave: Here, tmp_path: Path) -> None:
    command = (
        "sensitivity", "--method", "rule", "--volume", "900", "--seeds", "1:2", "--duration", "70",
        "--out", tmp_path / "study",
    )  # fmt: skip
    status, out, errors = laneweave(*command)
    assert status == 0, errors
    assert out.endswith("sensitivity.html: written\n")
    page = (tmp_path / "study" / "sensitivity.html").read_text(encoding="utf-8")
    assert "Mean delay with one setting changed at a time" in page
    assert "length of S3" in page
    found = json.loads((tmp_path / "study" / "sensitivity.json").read_text(encoding="utf-8"))
    volumes = next(one for one in found["factors"] if one["name"] == "volume")["levels"]
    assert [one["text"] for one in volumes] == ["720 veh/(lane h)", "1080 veh/(lane h)"]
    assert volumes[0]["delay_s"] <= volumes[1]["delay_s"]
    assert found["base"]["runs"] == 1
    _, _, errors = laneweave(*command)
    assert "runs were already finished" in errors[0]
    others = *command, "--seeds", "2:3", "--duration", "80"
    assert laneweave.refused(*others).startswith("--out")


def test_bad_input(laneweave: Here) -> None:
    refused = laneweave.refused
    assert refused("sensitivity", "--method", "rule,lc2013").startswith("--method: got 'rule,lc")
    assert refused("sensitivity", "--duration", "30").startswith("demand.duration_s: got 30")
    assert refused("sensitivity", "--volume", "-1").startswith("demand.volume_veh_per_lane_h")
