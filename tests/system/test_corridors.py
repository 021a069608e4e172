"""A corridor of a SUMO simulation with real processes, and what is refused."""

from __future__ import annotations

import re
import sys
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.commands import run
from support.drawn_corridors import draw_corridor, problems
from support.harness import Ended, Lab, check_safe_and_complete, summary, trips
from support.interchange import (
    CORRIDOR,
    DRIVEN_S,
    LONGEST_CORRIDOR,
    TRUCKS,
    driven_interchange,
    stream,
    write_interchange,
)


def refused(lab: Lab, *words: object, expected: str, status: int = 2) -> Ended:
    """Run a command that is refused in one line, and check that it leaves no folder."""
    ended = lab.run_forked(*words, "--out", lab.folder / "out")
    (line,) = ended.complaints
    assert ended.status == status
    assert expected in line
    assert not (lab.folder / "out").exists()
    return ended


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return write_interchange(tmp_path, stream(DRIVEN_S), types=TRUCKS)


def test_real_processes_drive_the_same_trips_as_a_simulated_run(
    lab: Lab, config: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = lab.folder / "zenoh"
    options = "--sumocfg", config, "--corridor", CORRIDOR
    faults = lab.path("killed.toml", "[[kill]]\ntarget = 'leader'\nat_s = 25.0\n")
    processes = "--vehicles-per-process", "10", "--faults", faults
    ended = lab.run("run", *options, *processes, "--out", folder)
    assert (ended.status, ended.complaints) == (0, []), ended
    check_safe_and_complete(folder)
    vehicles = summary(folder)["vehicles"]
    assert vehicles["at_destination"] == vehicles["demanded"] == 18
    _, simulated = driven_interchange(tmp_path_factory)
    ours, theirs = trips(folder), trips(simulated)
    assert ours.keys() == theirs.keys()
    for name, trip in ours.items():
        assert trip["entered_s"] == pytest.approx(theirs[name]["entered_s"], abs=0.11)
        assert trip["left_s"] == pytest.approx(theirs[name]["left_s"], abs=0.3)


@pytest.mark.full
@pytest.mark.parametrize("seed", range(20))
def test_real_processes_drive_drawn_corridors(lab: Lab, tmp_path: Path, seed: int) -> None:
    drawn, folder = draw_corridor(seed, tmp_path), lab.folder / "run"
    options = "--sumocfg", drawn.config, "--corridor", drawn.name
    ended = lab.run("run", *options, "--vehicles-per-process", "10", "--out", folder)
    if ended.status == 2:
        pytest.skip(f"refused: {ended.complaints}")
    assert (ended.status, ended.complaints) == (0, []), (ended, drawn.text)
    check_safe_and_complete(folder)
    assert problems(drawn, folder) == [], drawn.text


def test_corridors_are_listed_described_and_written(lab: Lab, config: Path) -> None:
    verbose = '<report><verbose value="true"/></report></configuration>'
    text = config.read_text(encoding="utf-8")
    config.write_text(text.replace("</configuration>", verbose), encoding="utf-8")
    listed = lab.run_forked("corridor", config)
    assert listed.status == 0, listed
    assert LONGEST_CORRIDOR in listed.out
    described = lab.run_forked("corridor", config, "--corridor", CORRIDOR)
    assert "exit to off from lane 0 at 946 m" in described.out
    assert "on-ramp from on into lane 0 at 1110 m" in described.out
    written = lab.run_forked("corridor", config, "--corridor", CORRIDOR, "--toml")
    tables = tomllib.loads(written.out)
    assert tables["sumo"] == {"config": str(config), "corridor": CORRIDOR}


@pytest.mark.more
def test_what_was_written_and_edited_is_run(lab: Lab, config: Path) -> None:
    written = lab.run_forked("corridor", config, "--corridor", CORRIDOR, "--toml")
    file = lab.path("edited.toml", written.out.replace("cycle_s = 4.0", "cycle_s = 3.8"))
    folder = lab.folder / "edited"
    ended = lab.run("run", file, "--transport", "simulated", "--out", folder, "--compare")
    assert (ended.status, ended.complaints) == (0, []), ended
    assert "comparison:" in ended.out
    assert (folder / "comparison.html").is_file()
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
        (("--sumocfg", "CONFIG", "--corridor", "main1:off:x"), "--corridor: got 'main1:off:x'"),
        (("--sumocfg", "CONFIG", "--corridor", "main5:main1"), "0 edges can be reached"),
        (("--sumocfg", "CONFIG", "--corridor", CORRIDOR, "--volume", "9"), "--volume: got 9.0"),
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
    assert refused(lab, "run", *words, expected=expected).out == ""


def test_a_window_without_a_screen_is_refused_in_one_line(
    lab: Lab, config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    options = "--sumocfg", config, "--corridor", CORRIDOR, "--gui", "--transport", "simulated"
    refused(lab, "run", *options, expected="sumo-gui needs a screen", status=1)


def test_the_volume_of_a_corridor_is_that_of_its_simulation(lab: Lab, config: Path) -> None:
    written = lab.run_forked("corridor", config, "--corridor", CORRIDOR, "--toml").out
    file = lab.path("corridor.toml", written)
    refused(lab, "sweep", file, "--volumes", "900", expected="--volumes: got '900'")


def test_a_road_that_is_not_that_of_the_corridor_is_refused(lab: Lab, config: Path) -> None:
    written = lab.run_forked("corridor", config, "--corridor", CORRIDOR, "--toml").out
    wrong = lab.path("wrong.toml", written.replace("lane_width_m = 3.2", "lane_width_m = 3.3"))
    expected = "road.lane_width_m: got 3.3; allowed: 3.2, as the corridor main1:main5 has"
    refused(lab, "run", wrong, "--transport", "simulated", expected=expected)


@pytest.mark.more
def test_a_network_from_opendrive(lab: Lab, config: Path) -> None:
    """Names of edges are new after the interchange was written as OpenDRIVE and read again."""
    network, drive = (config.with_name(name) for name in ("small.net.xml", "small.xodr"))
    netconvert = Path(sys.executable).with_name("netconvert")
    written = run(
        netconvert, "-s", network, "--opendrive-output", drive, "-o", lab.folder / "unused.net.xml"
    )
    assert written.returncode == 0, written.stderr
    read = run(netconvert, "--opendrive-files", drive, "-o", network)
    assert read.returncode == 0, read.stderr
    names = dict(_names_of_edges(network))
    assert names["main1"].startswith("-")
    routes = config.with_name("small.rou.xml")
    text = routes.read_text(encoding="utf-8")
    for old, new in names.items():
        text = re.sub(rf"(?<=[ \"]){old}(?=[ \"])", new, text)
    routes.write_text(text, encoding="utf-8")
    folder = lab.folder / "run"
    corridor = f"{names['main1']}:{names['main5']}"
    options = "--sumocfg", config, "--corridor", corridor, "--transport", "simulated"
    ended = lab.run("run", *options, "--out", folder)
    assert (ended.status, ended.complaints) == (0, []), ended
    check_safe_and_complete(folder)
    assert summary(folder)["vehicles"]["at_destination"] == 18


def _names_of_edges(network: Path) -> Iterator[tuple[str, str]]:
    """Yield (name in the interchange, name in the network) of the edges."""
    root = ET.parse(network).getroot()  # noqa: S314 (written by netconvert)
    lanes = {edge.attrib["id"]: len(edge.findall("lane")) for edge in root.iter("edge")}
    after: dict[str, set[str]] = {name: set() for name in lanes if not name.startswith(":")}
    for link in root.iter("connection"):
        if link.attrib["from"] in after:
            after[link.attrib["from"]].add(link.attrib["to"])
    begins = after.keys() - set[str]().union(*after.values())
    for name, count, route in (("start", 3, "main1 main2"), ("before", 1, "on")):
        (edge,) = (each for each in begins if lanes[each] == count)
        yield name, edge
        for behind in route.split():
            (edge,) = after[edge]
            yield behind, edge
    (edge,) = (each for each in after if {lanes[one] for one in after[each]} == {1, 3})
    for name, count in (("off", 1), ("main3", 3)):
        (found,) = (each for each in after[edge] if lanes[each] == count)
        yield name, found
    (main4,) = after[found]
    yield "main4", main4
    yield from (("main5", each) for each in after[main4])
