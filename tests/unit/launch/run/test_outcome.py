"""The problems that fail a run, and the table at its end."""

import io
import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from rich.console import Console

from laneweave.launch.cli.corridor_command import corridor_tables
from laneweave.launch.faults.failover import Failover
from laneweave.launch.report.summary_table import summary_rows
from laneweave.launch.run import outcome as outcome_module
from laneweave.launch.run.outcome import Outcome, complete_summary, print_outcome
from laneweave.protocol.config.scenario_files import load_scenario, parse_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.summary import RunSummary, write_summary
from laneweave.sim_bridge.corridors.sumo_corridor import read_corridor
from laneweave.sim_bridge.corridors.sumo_simulation import WHOLE
from laneweave.sim_bridge.recording.trips import metadata_of
from support.closed_lanes import DROP
from support.interchange import CORRIDOR, TRUCKS, stream, write_interchange
from support.recorded_trips import trips_table
from support.summaries import make_summary
from support.tables import for_each

MEASURED = ("min_gap_m", "min_headway_s", "max_accel_mps2", "min_accel_mps2", "max_jerk_mps3")

COMFORT = {
    "accel_rms_mps2": 0.3,
    "accel_p95_mps2": 0.4,
    "jerk_rms_mps3": 0.3,
    "jerk_p95_mps3": 0.5,
    "uncomfortable_percent": 0.31,
}
MANY_RECOVERIES = Failover(1.0, [0.1, 0.2, 0.3, 0.4, 0.5, 0.9], [])


def summary(
    *,
    overlaps: int = 0,
    left: int = 5,
    measured: float | None = 1.5,
    ending: str = "complete",
    entered: int = 5,
) -> RunSummary:
    return make_summary(
        ending=ending,
        vehicles={
            "demanded": 5,
            "entered": entered,
            "left": left,
            "on_preferred_lane": left,
            "peak": 4,
        },
        travel_time_s=dict.fromkeys(("mean", "p50", "p95", "max"), measured),
        safety={"overlaps": overlaps} | dict.fromkeys(MEASURED, measured),
        tracking={"osqp_solves": 17, "unconstrained_steps": 50_383},
    )


def judge(folder: Path, found: RunSummary, **more: Any) -> Outcome:  # noqa: ANN401
    write_summary(folder, found)
    return complete_summary(folder, **{"problems": (), "processes": 9, **more})


def test_a_run_without_problems(tmp_path: Path) -> None:
    outcome = judge(tmp_path, summary(), dropped=3, failover=Failover(1.0, [0.25], [0.5]))

    assert outcome.exit_status == 0
    written = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert outcome.summary == RunSummary.from_json(written)
    assert written["runtime"]["processes"] == 9
    assert written["messages"] == {"published": 7, "dropped_by_faults": 3}
    # Recoveries measured here replace those of the bridge.
    failover = written["failover"]
    assert (failover["recovery_s"], failover["plan_recovery_s"]) == ([0.25], [0.5])


@for_each(
    ("found", "problem"),
    [
        (summary(overlaps=2), "2 pairs of vehicles overlapped"),
        (summary(left=3), "2 of 5 vehicles did not leave the road"),
        (summary(ending="interrupted"), "the run is not complete: interrupted"),
        (summary(ending="limit"), "the run is not complete: limit (runtime.max_road_s)"),
    ],
)
def test_a_broken_promise_fails_a_run(tmp_path: Path, found: RunSummary, problem: str) -> None:
    outcome = judge(tmp_path, found)
    assert outcome.exit_status == 1
    assert outcome.problems == (problem,)


def test_vehicles_that_stay_outside_do_not_fail_a_complete_run(tmp_path: Path) -> None:
    lost = judge(tmp_path, summary(entered=3, left=3))
    assert lost.problems == ("2 of 5 vehicles did not leave the road",)
    config = write_interchange(tmp_path, stream(9), types=TRUCKS)
    tables = corridor_tables(read_corridor(config, CORRIDOR), config, WHOLE)
    of_sumo = parse_scenario(tables)
    pq.write_table(trips_table([], 0.0, metadata_of(of_sumo)), tmp_path / "trips.parquet")
    outside = judge(tmp_path, summary(entered=3, left=3))
    assert outside.exit_status == 0
    assert "never entered: did not come to the corridor, or exit full" in printed(outside)
    assert "never entered" not in printed(judge(tmp_path, summary()))
    stopped = judge(tmp_path, summary(entered=3, left=3, ending="limit"))
    assert stopped.problems[1] == "2 of 5 vehicles did not leave the road"
    assert "never entered" not in printed(stopped)


def test_a_problem_fails_a_run_that_kept_its_promises(tmp_path: Path) -> None:
    outcome = judge(tmp_path, summary(), problems=["interrupted"])
    assert (outcome.exit_status, outcome.problems) == (1, ("interrupted",))


def test_an_interrupted_run_has_not_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outcome = judge(tmp_path, summary(left=3, ending="interrupted"), interrupted=True)
    assert (outcome.exit_status, outcome.problems) == (1, ())
    assert outcome.ending == "run interrupted: 3 of 5 left"
    with pytest.raises(KeyboardInterrupt):
        outcome.or_interrupt()
    assert "FAILED" not in printed(outcome)
    said = f"interrupted at 100.0 s of road time; the data so far: {tmp_path}\n"
    assert capsys.readouterr().err == said
    unsafe = judge(tmp_path, summary(left=3, ending="interrupted", overlaps=1), interrupted=True)
    assert unsafe.problems == ("1 pairs of vehicles overlapped",)
    assert unsafe.ending == "run failed: 1 pairs of vehicles overlapped"


def test_a_signal_after_the_end_interrupts_nothing(tmp_path: Path) -> None:
    outcome = judge(tmp_path, summary(), interrupted=True)
    assert (outcome.exit_status, outcome.interrupted) == (0, False)
    assert outcome.ending == "run ended: 5 of 5 left"


def test_a_run_that_was_interrupted_before_it_began_has_no_outcome(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        complete_summary(tmp_path, problems=(), interrupted=True)


@pytest.mark.parametrize(
    "error", [OSError("no space"), BadInputError("DIR", "x", "y"), CommandFailedError("no model")]
)
def test_without_energy_the_rest_of_the_summary_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(_: Path) -> None:
        raise error

    monkeypatch.setattr(outcome_module, "energy_of", fail)
    outcome = judge(tmp_path, summary(), dropped=3)
    assert (outcome.exit_status, outcome.problems) == (0, ())
    written = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert (written["runtime"]["processes"], "energy" in written) == (9, False)


def test_a_run_without_a_summary_failed(tmp_path: Path) -> None:
    outcome = complete_summary(tmp_path, problems=["the bridge ended"], processes=3)
    assert outcome.exit_status == 1
    assert outcome.summary is None
    assert outcome.problems == ("the bridge ended", "the run wrote no summary")


def printed(outcome: Outcome) -> str:
    stream = io.StringIO()
    print_outcome(outcome, Console(file=stream, width=120))
    return stream.getvalue()


@for_each(
    ("found", "more", "row"),
    [
        (summary(), {}, ("processes", "9")),
        (summary(), {}, ("ticks tracked without OSQP", "50,383")),
        (summary(), {}, ("vehicles demanded", "5")),
        (summary(), {}, ("left in their preferred lane", "100.00 % of 5 vehicles")),
        (
            summary(),
            {"failover": Failover(1.0, [0.25], [0.5])},
            ("time without leader, median", "0.250 s (1 time)"),
        ),
        (
            summary(),
            {"failover": MANY_RECOVERIES},
            ("time without leader, median", "0.350 s (6 times)"),
        ),
        (summary(), {"failover": MANY_RECOVERIES}, ("time without leader, maximum", "0.900 s")),
        (
            make_summary(safety={"min_ttc_s": 2.5, "ttc_below_3_s": 0.7}),
            {},
            ("time below 3 s to collision", "0.7 s"),
        ),
        (make_summary(comfort=COMFORT), {}, ("time beyond 2 m/s² or 2.5 m/s³", "0.31 %")),
    ],
)
def test_the_table_at_the_end(
    tmp_path: Path, found: RunSummary, more: dict[str, Any], row: tuple[str, str]
) -> None:
    outcome = judge(tmp_path, found, **more)
    assert outcome.summary is not None
    assert row in summary_rows(outcome.summary)
    name, value = row
    assert any(name in line and value in line for line in printed(outcome).splitlines())


def test_a_mean_says_of_how_many_vehicles_it_is() -> None:
    found = make_summary(travel_time_s={"mean": 71.5, "n": 29}, vehicles={"demanded": 91})
    assert dict(summary_rows(found))["travel time, mean"] == "71.50 s (29 of 91 vehicles)"
    none = make_summary(travel_time_s={"mean": None, "n": 0}, vehicles={"demanded": 26})
    assert dict(summary_rows(none))["travel time, mean"] == "none (0 of 26 vehicles)"
    without = make_summary(travel_time_s={"mean": 71.5})
    assert dict(summary_rows(without))["travel time, mean"] == "71.50 s"


def test_the_table_has_no_row_without_a_value(tmp_path: Path) -> None:
    rows = dict(summary_rows(summary(left=0, measured=None)))
    unknown = ("travel time", "smallest", "acceleration", "preferred lane")
    assert [name for name in rows if any(part in name for part in unknown)] == []
    assert all(value and "-" not in value for value in rows.values())
    assert " - " not in printed(judge(tmp_path, summary(left=0, measured=None)))


def test_the_table_of_a_reference_method_has_no_plans() -> None:
    found = make_summary(method="rule", planning={"plans": 0}, tracking={"solves": 0})
    names = [name for name, _ in summary_rows(found)]
    assert [name for name in names if "plan" in name or "leader" in name or "track" in name] == []
    assert "real-time factor" in names


def test_the_table_says_how_long_vehicles_arrived() -> None:
    rows = dict(summary_rows(summary(), load_scenario(None, demand__duration_s=40.0)))
    assert rows["arrivals during"] == "40 s"
    assert rows["vehicles demanded"] == "5"


def test_the_table_names_no_preferred_lanes_on_a_road_without_them(tmp_path: Path) -> None:
    pq.write_table(trips_table([], 0.0, metadata_of(DROP)), tmp_path / "trips.parquet")
    assert "preferred lane" not in printed(judge(tmp_path, summary()))


def test_names_with_brackets_are_printed_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = Path("a[", "b][red]")
    folder.mkdir(parents=True)
    outcome = judge(folder, summary(), problems=["the router [/x] ended [bold]"])
    text = io.StringIO()
    print_outcome(outcome, Console(file=text, width=400))
    assert f"laneweave run: {folder}" in text.getvalue()
    assert "FAILED: the router [/x] ended [bold]\n" in text.getvalue()


def test_all_reasons_are_printed(tmp_path: Path) -> None:
    found = summary(overlaps=1, left=4, ending="limit")
    text = printed(judge(tmp_path, found, problems=["the router [9] ended"]))
    assert [line for line in text.splitlines() if line.startswith("FAILED")] == [
        "FAILED: the router [9] ended",
        "FAILED: 1 pairs of vehicles overlapped",
        "FAILED: the run is not complete: limit (runtime.max_road_s)",
        "FAILED: 1 of 5 vehicles did not leave the road",
    ]


@for_each(
    ("more", "shown"),
    [
        ({"optimal": 0}, {"plans": "5", "plans proven optimal": "0 of 5"}),
        ({"by_solver": {"rolling": 5}, "optimal": 0, "fallbacks": 0}, {"plans by rolling": "5"}),
        (
            {"by_solver": {"tappa": 3, "branching": 2}, "fallbacks": 2, "optimal": 4},
            {
                "plans proven optimal": "4 of 5",
                "plans by tappa": "3",
                "plans by branching": "2",
                "plans by a fallback": "2",
            },
        ),
        ({"plans": 0, "by_solver": {"tappa": 0, "branching": 0}, "fallbacks": 0}, {"plans": "0"}),
    ],
)
def test_the_table_says_which_solvers_planned(more: dict[str, Any], shown: dict[str, str]) -> None:
    found = make_summary(planning={"plans": 5} | more)
    rows = {name: value for name, value in summary_rows(found) if name.startswith("plans")}
    assert rows == {"plans": "5"} | shown


@for_each(
    ("low", "high", "said"),
    [
        (-2.004, 2.0, ("-2.00 m/s²", "2.00 m/s²")),
        (-2.01, 1.0, ("-2.01 m/s², beyond comfort (2 m/s²)", "1.00 m/s²")),
        (-1.0, 4.8, ("-1.00 m/s²", "4.80 m/s², beyond comfort (2 m/s²)")),
        (None, None, (None, None)),
    ],
)
def test_accelerations_that_are_not_comfortable(
    low: float | None, high: float | None, said: tuple[str | None, str | None]
) -> None:
    found = make_summary(safety={"min_accel_mps2": low, "max_accel_mps2": high})
    rows = dict(summary_rows(found))
    assert (rows.get("lowest acceleration"), rows.get("highest acceleration")) == said
