"""What SUMO reads of a configuration, and what laneweave adds."""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from pathlib import Path

import pytest

from laneweave.protocol.errors import BadInputError
from laneweave.sim_bridge.corridors.sumo_config import read_config
from laneweave.sim_bridge.corridors.sumo_simulation import read_simulation
from support.interchange import vehicle, write_interchange

FILES = '<net-file value="small.net.xml"/><route-files value="small.rou.xml"/>'
FLOW = (
    '<flow id="f" type="car" begin="0" end="60" period="3" departLane="free">'
    '<route edges="main1 main2 main3 main4 main5"/></flow>'
)


def write_config(folder: Path, text: str, vehicles: Sequence[str] = (FLOW,)) -> Path:
    write_interchange(folder, vehicles)
    config = folder / "own.sumocfg"
    config.write_text(f"<configuration>{text}</configuration>", encoding="utf-8")
    return config


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ('<input><net v="small.net.xml"/><routes v="small.rou.xml"/></input>', 20),
        (f"{FILES}<scale value='2'/>", 40),
        (f"<input>{FILES}</input><time><b v='0:00:30'/><e v='-1'/></time>", 10),
        (f"<input>{FILES}<weight-files value='weights.xml'/></input>", 20),
        ('<n v="${LANEWEAVE_TEST_FOLDER}/small.net.xml"/><r v="small.rou.xml"/>', 20),
        (f"{FILES}<output><human-readable-time value='true'/></output>", 20),
        (f"{FILES}<additional-files value='more.xml, other file.xml'/>", 20),
        (f"{FILES}<route-steps value='10'/><random value='true'/>", 20),
    ],
    ids=[
        "synonyms",
        "scale",
        "times",
        "weights",
        "environment",
        "human-readable",
        "blanks",
        "random",
    ],
)
def test_options_mean_what_they_mean_to_sumo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, count: int
) -> None:
    monkeypatch.setenv("LANEWEAVE_TEST_FOLDER", str(tmp_path))
    weights = '<meandata><interval begin="0" end="9"><edge id="main1" traveltime="9"/></interval>'
    (tmp_path / "weights.xml").write_text(f"{weights}</meandata>", encoding="utf-8")
    for name in ("more.xml", "other file.xml"):
        (tmp_path / name).write_text("<additional/>", encoding="utf-8")
    found = read_simulation(write_config(tmp_path, text))
    assert len(found.vehicles) == count


BUS = (
    '<vehicle id="bus" type="own" depart="2"><route edges="before on"/>'
    '<stop busStop="here" duration="3"/></vehicle>'
)
DISTRICTS = (
    '<flow id="t" type="own" begin="0" end="9" number="3" fromTaz="A" toTaz="B"/>'
    '<trip id="u" type="own" depart="3" fromTaz="A" toTaz="B"/>'
)


@pytest.mark.parametrize("compressed", [False, True], ids=["plain", "gz"])
@pytest.mark.parametrize(
    ("additional", "vehicles", "count"),
    [
        ('<busStop id="here" lane="on_0" startPos="50" endPos="90"/>', BUS, 1),
        ('<taz id="A" edges="main1"/><taz id="B" edges="main5"/>', DISTRICTS, 4),
        ('<include href="types.xml"/>', vehicle("a", 0.0, "main", "included"), 1),
        (vehicle("a", 0.0, "main", "own"), vehicle("b", 0.0, "ramp", "own"), 2),
        ('<poly id="p" shape="0,0 1,1 2,0"/>', vehicle("a", 0.0, "main", "own"), 1),
        (
            (
                '<rerouter id="r" edges="main1"><interval begin="0" end="99">'
                '<destProbReroute id="off"/></interval></rerouter>'
            ),
            vehicle("a", 0.0, "main", "own"),
            1,
        ),
    ],
    ids=["bus-stop", "districts", "include", "vehicles", "drawing", "rerouter"],
)
def test_additional_files_are_read(
    tmp_path: Path, additional: str, vehicles: str, count: int, *, compressed: bool
) -> None:
    own = '<vType id="own" accel="3"/>'
    (tmp_path / "types.xml").write_text(
        '<additional><vType id="included"/></additional>', encoding="utf-8"
    )
    text = f"<additional>{own}{additional}</additional>".encode()
    name = "more.add.xml.gz" if compressed else "more.add.xml"
    (tmp_path / name).write_bytes(gzip.compress(text) if compressed else text)
    config = write_config(
        tmp_path, f"<input>{FILES}<additional-files value='{name}'/></input>", [vehicles]
    )
    found = read_simulation(config)
    assert len(found.vehicles) == count
    if "rerouter" in additional:
        assert found.vehicles[0].route[-1] == "off"


def test_no_output_of_the_configuration_is_written(tmp_path: Path) -> None:
    detector = '<inductionLoop id="d" lane="main1_0" pos="9" period="9" file="detector.xml"/>'
    (tmp_path / "d.add.xml").write_text(f"<additional>{detector}</additional>", encoding="utf-8")
    text = (
        f"<input>{FILES}<additional-files value='d.add.xml'/></input><output>"
        '<tripinfo-output value="trips.xml"/><fcd-output value="fcd.xml"/></output>'
        '<report><log value="log.txt"/></report>'
    )
    config = write_config(tmp_path, text)
    before = {*tmp_path.iterdir()}
    assert read_simulation(config).vehicles
    assert {*tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "net-file: got no value"),
        ('<net-file value="no.xml"/>', r"no\.xml"),
        ('<net-file value="small.net.xml"/><route-files value="no.xml"/>', r"route-files.*no\.xml"),
        (f"{FILES}<no-such-option value='1'/>", "a configuration that SUMO can read"),
        (f"{FILES}<mesosim value='true'/>", "mesosim.*mesoscopic"),
        (f"{FILES}<no-internal-links value='true'/>", "no-internal-links.*inside junctions"),
        (f"{FILES}<load-state value='x.xml'/>", "load-state"),
    ],
)
def test_a_simulation_of_another_kind_is_refused(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(BadInputError, match=expected):
        read_config(write_config(tmp_path, text), tmp_path)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("small.net.xml", "the file is a network"),
        ("small.rou.xml", "the file is a file of routes"),
        ("none.sumocfg", "a readable file"),
        ("text.sumocfg", "XML"),
        ("empty.sumocfg", "XML"),
    ],
)
def test_another_file_is_named(tmp_path: Path, name: str, expected: str) -> None:
    write_interchange(tmp_path)
    (tmp_path / "text.sumocfg").write_text("not XML", encoding="utf-8")
    (tmp_path / "empty.sumocfg").write_bytes(b"")
    with pytest.raises(BadInputError, match=expected):
        read_config(tmp_path / name, tmp_path)


def test_options_of_the_configuration_stay(tmp_path: Path) -> None:
    text = f"{FILES}<time-to-teleport value='60'/><verbose value='true'/><seed value='7'/>"
    found = read_config(write_config(tmp_path, text), tmp_path)
    assert found.options["time-to-teleport"] == "60"
    assert "verbose" not in found.options
    command = found.command(1, {}, without=("time-to",))
    assert "--time-to-teleport" not in command
    assert command[command.index("--seed") + 1] == "7"
