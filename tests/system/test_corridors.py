"""A corridor of a SUMO simulation with real processes, and what is refused."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from support.harness import Lab, check_safe_and_complete, summary, trips
from support.interchange import CORRIDOR, LONGEST_CORRIDOR, TRUCKS, stream, write_interchange


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return write_interchange(tmp_path, stream(15), types=TRUCKS)


def test_real_processes_drive_the_same_trips_as_a_simulated_run(lab: Lab, config: Path) -> None:
    folders = lab.folder / "zenoh", lab.folder / "simulated"
    options = "--sumocfg", config, "--corridor", CORRIDOR
    faults = lab.path("killed.toml", "[[kill]]\ntarget = 'leader'\nat_s = 25.0\n")
    processes = "--vehicles-per-process", "10", "--faults", faults
    ended = lab.run("run", *options, *processes, "--out", folders[0], "--compare")
    assert (ended.status, ended.complaints) == (0, []), ended
    assert "comparison:" in ended.out
    assert (folders[0] / "comparison.html").is_file()
    check_safe_and_complete(folders[0])
    vehicles = summary(folders[0])["vehicles"]
    assert vehicles["at_destination"] == vehicles["demanded"] == 18
    ended = lab.run("run", *options, "--transport", "simulated", "--out", folders[1])
    assert ended.status == 0, ended
    ours, theirs = (trips(folder) for folder in folders)
    assert ours.keys() == theirs.keys()
    for name, trip in ours.items():
        assert trip["entered_s"] == pytest.approx(theirs[name]["entered_s"], abs=0.11)
        assert trip["left_s"] == pytest.approx(theirs[name]["left_s"], abs=0.3)


def test_corridors_are_listed_described_and_written(lab: Lab, config: Path) -> None:
    listed = lab.run_forked("corridor", config)
    assert listed.status == 0, listed
    assert LONGEST_CORRIDOR in listed.out
    described = lab.run_forked("corridor", config, "--corridor", CORRIDOR)
    assert "exit to off from lane 0 at 946 m" in described.out
    assert "on-ramp from on into lane 0 at 1110 m" in described.out
    written = lab.run_forked("corridor", config, "--corridor", CORRIDOR, "--toml")
    tables = tomllib.loads(written.out)
    assert tables["sumo"] == {"config": str(config), "corridor": CORRIDOR}
    file = lab.path("edited.toml", written.out.replace("cycle_s = 4.0", "cycle_s = 3.8"))
    folder = lab.folder / "edited"
    ended = lab.run("run", file, "--transport", "simulated", "--out", folder)
    assert (ended.status, ended.complaints) == (0, []), ended
    assert summary(folder)["vehicles"]["at_destination"] == 18


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--corridor", CORRIDOR), "--sumocfg: "),
        (("--sumocfg", "CONFIG"), "--corridor: "),
        (
            ("--sumocfg", "nowhere.sumocfg", "--corridor", CORRIDOR),
            "SUMOCFG: got 'nowhere.sumocfg'",
        ),
        (("--sumocfg", "CONFIG", "--corridor", "main1:off:x"), "--corridor: got 'off:x'"),
        (("--sumocfg", "CONFIG", "--corridor", "main5:main1"), "0 edges can be reached"),
        (("--sumocfg", "CONFIG", "--corridor", CORRIDOR, "--volume", "9"), "--volume: got '9.0'"),
        (
            ("--sumocfg", "CONFIG", "--corridor", CORRIDOR, "--method", "rule"),
            "--method: got 'rule'",
        ),
        (("--compare",), "--compare: "),
    ],
)
def test_what_does_not_fit_is_one_line(
    lab: Lab, config: Path, options: tuple[str, ...], expected: str
) -> None:
    words = [config if word == "CONFIG" else word for word in options]
    ended = lab.run_forked("run", *words, "--out", lab.folder / "run")
    (line,) = ended.complaints
    assert (ended.status, ended.out) == (2, "")
    assert expected in line
    assert not (lab.folder / "run").exists()


def test_a_road_that_is_not_that_of_the_corridor_is_refused(lab: Lab, config: Path) -> None:
    written = lab.run_forked("corridor", config, "--corridor", CORRIDOR, "--toml").out
    wrong = lab.path("wrong.toml", written.replace("lane_width_m = 3.2", "lane_width_m = 3.3"))
    ended = lab.run_forked("run", wrong, "--transport", "simulated", "--out", lab.folder / "run")
    (line,) = ended.complaints
    assert ended.status == 2
    assert "road.lane_width_m: got 3.3; allowed: 3.2, as the corridor main1:main5 has" in line
