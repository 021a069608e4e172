"""The points of a sweep, and refused input."""

from __future__ import annotations

from pathlib import Path

import pytest

from laneweave.launch.run_methods import METHODS, KeepTrajectories, parse_methods, rank
from laneweave.launch.sweep.points import plan_points, sweep_volumes
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from support.commands import Here
from support.tables import for_each

ROOT = Path(__file__).resolve().parents[4]


def test_points_are_named_by_label_volume_and_seed() -> None:
    points = plan_points(
        load_scenario(None, demand__duration_s=40.0),
        ["formation", "paper-12"],
        [1450.5],
        range(7, 9),
        KeepTrajectories.first_seed,
    )
    assert [(point.name, point.keep_trajectories) for point in points] == [
        ("formation-1450.5-7", True),
        ("paper-12-1450.5-7", True),
        ("formation-1450.5-8", False),
        ("paper-12-1450.5-8", False),
    ]
    for point in points:
        assert point.scenario.demand.duration_s == 40.0
        assert point.scenario.demand.volume_veh_per_lane_h == 1450.5
        assert point.name.endswith(f"-{point.scenario.seed}")


@for_each(
    ("label", "columns", "vehicles"), [("paper-6", 4, 6), ("paper-12", 8, 12), ("paper-18", 12, 18)]
)
@for_each(
    "base",
    [
        load_scenario(None, formation__block_columns=6, formation__max_vehicles=4),
        load_scenario(None, formation__operation="rolling"),
    ],
)
def test_labels_bring_their_settings(
    base: Scenario, label: str, columns: int, vehicles: int
) -> None:
    formation = METHODS[label].settings(base).formation
    assert (formation.block_columns, formation.max_vehicles) == (columns, vehicles)
    assert (formation.operation, formation.entry, formation.close) == (
        "formations", "interlaced", "columns",
    )  # fmt: skip
    assert METHODS[label].settings(base).timing.cycles_s == (4.0, 4.0)
    assert METHODS[label].settings(base).timing.move_s == pytest.approx(3.8)
    assert METHODS["formation"].settings(base) == base


def test_the_label_formations_has_the_default_settings_in_any_scenario() -> None:
    default, paper = load_scenario(None), load_scenario(ROOT / "scenarios" / "paper.toml")
    found = METHODS["formations"].settings(paper)
    assert found.timing.cycles_s == default.timing.cycles_s == (4.0, 7.0)
    assert found.formation.closes_by_vehicles
    assert not found.formation.interlaced
    assert found.formation.max_vehicles == 6
    # Road and demand stay the scenario's.
    assert (found.road, found.demand) == (paper.road, paper.demand)


def test_labels_are_sorted_as_in_their_table() -> None:
    labels = ["z", "paper-12", "a", "formation"]
    assert sorted(labels, key=rank) == ["formation", "paper-12", "a", "z"]


@for_each(
    ("keep", "kept"),
    [
        (KeepTrajectories.none, [False, False]),
        (KeepTrajectories.first_seed, [True, False]),
        (KeepTrajectories.all, [True, True]),
    ],
)
def test_kept_trajectories(keep: KeepTrajectories, kept: list[bool]) -> None:
    points = plan_points(Scenario(), ["formation"], [1000.0], range(2), keep)
    assert [point.keep_trajectories for point in points] == kept


@for_each("text", ["", "magic", "formation,", "formation,formation"])
def test_bad_methods(text: str) -> None:
    with pytest.raises(BadInputError, match="--methods: got "):
        parse_methods(text)


@for_each("text", ["", "a", "1000,", "0", "-5", "5000", "nan", "inf", "1e3,1000"])
def test_bad_volumes(text: str) -> None:
    with pytest.raises(BadInputError, match="--volumes: got "):
        sweep_volumes(text, Scenario())


def test_volumes_and_labels_that_do_not_fit_the_scenario() -> None:
    with pytest.raises(BadInputError, match="--volumes: got '1600'"):
        sweep_volumes("1000,1600", load_scenario(None, demand__min_headway_s=3.0))
    base = load_scenario(None, road__s3_m=160.0)
    with pytest.raises(BadInputError, match=r"road.s3_m \(paper-12\): got 160.0"):
        plan_points(base, ["paper-12"], [1000.0], range(1), KeepTrajectories.none)


def test_too_many_points() -> None:
    with pytest.raises(BadInputError, match="at most 100000 runs, not 200000"):
        plan_points(Scenario(), ["formation"], [1.0, 2.0], range(100_000), KeepTrajectories.none)


@for_each(
    ("arguments", "said"),
    [
        (["--methods", "magic"], "--methods: got 'magic'; allowed: one of formation"),
        (["--volumes", "1000,x"], "--volumes: got 'x'; allowed: comma-separated numbers"),
        (["--seeds", "3"], "--seeds: got '3'; allowed: A:B with A < B"),
        (["--jobs", "0"], "--jobs: got 0; allowed: [1, 256]"),
        (["--duration", "0"], "demand.duration_s: got 0.0"),
        (["--dask", "tcp://127.0.0.1:1", "--jobs", "2"], "--jobs: got 2; allowed: only without"),
        (
            ["--dask", "nonsense"],
            "--dask: got 'nonsense'; allowed: the address of a Dask scheduler",
        ),
        (["--out", "/dev/null/out"], "--out: got '/dev/null/out'"),
        (["--keep-trajectories", "some"], "--keep-trajectories"),
        (["missing.toml"], "missing.toml"),
    ],
)
def test_one_line_says_what_is_wrong(
    laneweave: Here,
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert said in laneweave.refused("sweep", *arguments)
