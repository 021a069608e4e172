"""A corridor of a SUMO simulation as a whole: SUMO, bridge, agents, coordinators in one process."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest

from laneweave.launch.cli.corridor_command import corridor_tables
from laneweave.launch.recordings.trajectories import read_trajectories, read_trips
from laneweave.launch.report.corridor_comparison import ALONE_FOLDER, compare
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.sim_bridge.corridors import corridor_setup, sumo_statistics
from laneweave.sim_bridge.corridors.hand_over import HandOver
from laneweave.sim_bridge.corridors.sumo_corridor import read_corridor
from laneweave.sim_bridge.corridors.sumo_simulation import TimeWindow
from laneweave.sim_bridge.corridors.sumo_statistics import read_statistics
from support.interchange import (
    CORRIDOR,
    DRIVEN_S,
    EXIT_FIRST,
    FORK,
    POCKET,
    RAMP_FIRST,
    RAMP_SPEED_MPS,
    TRUCKS,
    Network,
    driven_interchange,
    scenario_of,
    stream,
    vehicle,
    write_interchange,
)
from support.variants import variants

Events = list[dict[str, Any]]


def scenario(folder: Path, vehicles: Sequence[str], network: Network = EXIT_FIRST) -> Scenario:
    return scenario_of(write_interchange(folder, vehicles, types=TRUCKS, network=network))


def standing_vehicle(depart_s: int, at_m: int, stop: str) -> str:
    """Return the XML element of a vehicle that stands on the road behind the exit.

    Args:
        depart_s: when it appears.
        at_m: position of its front.
        stop: attribute that says how long it stands.
    """
    return (
        f'<vehicle id="standing" type="car" depart="{depart_s}" departPos="{at_m - 5}">'
        f'<route edges="off"/><stop lane="off_0" endPos="{at_m}" {stop}/></vehicle>'
    )


def read_rows(folder: Path) -> dict[tuple[str, int], tuple[float, float]]:
    """Return position and speed of each vehicle by tick."""
    columns = read_trajectories(folder, ["vehicle", "t_s", "s_m", "speed_mps"]).to_pydict()
    keys = zip(columns["vehicle"], (round(t_s / 0.1) for t_s in columns["t_s"]), strict=True)
    return dict(zip(keys, zip(columns["s_m"], columns["speed_mps"], strict=True), strict=True))


def hardest_braking_mps2(folder: Path) -> float:
    accels = read_trajectories(folder, ["accel_mps2"]).to_pydict()["accel_mps2"]
    return -min(map(float, accels))


def drive(own: Scenario, folder: Path) -> tuple[dict[str, Any], Events]:
    outcome = SimulatedRun(own, folder, show_progress=False).run()
    assert not outcome.problems
    return _results(folder)


def _results(folder: Path) -> tuple[dict[str, Any], Events]:
    events = (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
    return json.loads((folder / "summary.json").read_text()), [*map(json.loads, events)]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scenario, Path, dict[str, Any], Events]:
    own, folder = driven_interchange(tmp_path_factory)
    return own, folder, *_results(folder)


def test_everybody_gets_where_the_route_leads(
    run: tuple[Scenario, Path, dict[str, Any], Events],
) -> None:
    _, folder, summary, events = run
    assert summary["vehicles"]["left"] == summary["vehicles"]["demanded"] == 18
    assert summary["vehicles"]["at_destination"] == 18
    assert summary["safety"]["overlaps"] == summary["safety"]["sumo_collisions"] == 0
    assert summary["tracking"]["emergency_ticks"] == 0
    assert summary["safety"]["min_gap_m"] >= 8.0
    assert summary["travel_time_s"]["n"] == 18
    kinds = {event["kind"] for event in events}
    assert kinds.isdisjoint({"left-lattice", "missed-exit", "agent-missing", "planning-failed"})
    trips = read_trips(folder).values()
    assert {trip["sumo_id"] for trip in trips} == {
        *(f"m#{second}" for second in range(DRIVEN_S)),
        *(f"r.{second}" for second in range(0, DRIVEN_S, 6)),
    }


def test_sumo_counts_the_same_trips(
    run: tuple[Scenario, Path, dict[str, Any], Events],
) -> None:
    own, folder, _, _ = run
    found = read_statistics(folder)
    assert (found.collisions, found.teleports) == (0, 0)
    for trip in read_trips(folder).values():
        sumos = found.trips[trip["sumo_id"]]
        if trip["entrance"] == MAIN_ENTRANCE:
            assert sumos.depart_s == pytest.approx(trip["entered_s"], abs=0.15)
        if trip["destination"] == "end":
            # SUMO lets vehicles arrive at the end of the last edge.
            after_s = sumos.arrival_s - trip["left_s"]
            assert 0.0 <= after_s <= 4.0 / own.formation.speed_mps + 0.3
        assert sumos.fuel_g is not None


def test_sumo_drives_the_same_vehicles_alone(
    run: tuple[Scenario, Path, dict[str, Any], Events],
) -> None:
    own, folder, _, _ = run
    routes = compare(own, folder)
    counts = {(one.entrance, one.destination): (one.vehicles, *one.arrived) for one in routes}
    assert counts == {
        (MAIN_ENTRANCE, "end"): (13, 13, 13),
        (MAIN_ENTRANCE, "off"): (2, 2, 2),
        ("on", "end"): (3, 3, 3),
    }
    for one in routes:
        ours_s, sumos_s = one.mean_s
        assert ours_s is not None
        assert sumos_s is not None
        assert math.isclose(ours_s, sumos_s, rel_tol=0.15)
    page = (folder / "comparison.html").read_text(encoding="utf-8")
    assert "start of the corridor" in page
    assert "SUMO alone" in page


@pytest.mark.parametrize("origin", variants(["", "upstream "]))
def test_at_a_fork_everybody_is_in_a_lane_that_leads_to_the_next_edge(
    tmp_path: Path, origin: str
) -> None:
    turns = ["left", "right", "ahead"]
    vehicles = [vehicle(f"v{n}", n, origin + turns[n % 3]) for n in range(12)]
    config = write_interchange(tmp_path, vehicles, network=FORK)
    summary, _ = drive(scenario_of(config, "main1:main1"), tmp_path / "run")
    assert summary["vehicles"]["on_preferred_lane"] == summary["vehicles"]["demanded"] == 12
    assert summary["safety"]["overlaps"] == summary["safety"]["sumo_collisions"] == 0
    assert summary["safety"]["min_accel_mps2"] >= -3.0
    leads_to = {"right": {0}, "ahead": {0, 1}, "left": {2}}
    for trip in read_trips(tmp_path / "run").values():
        assert trip["final_lane"] in leads_to[turns[int(trip["sumo_id"][1:]) % 3]]


@pytest.mark.parametrize("origin", variants(["upstream ", ""]))
def test_sumo_takes_vehicles_back_before_the_queue_of_their_lane(
    tmp_path: Path, origin: str
) -> None:
    """The queue reaches 200 m back into the lane that turns left; the others drive past it."""
    stands = (
        '<vehicle id="stands" type="car" depart="0" departPos="5"><route edges="left"/>'
        '<stop lane="left_0" endPos="10" duration="110"/></vehicle>'
    )
    turns = ["left", "left", "ahead"]
    vehicles = [vehicle(f"v{n}", n, origin + turns[n % 3]) for n in range(36)]
    config = write_interchange(tmp_path, [stands, *vehicles], network=FORK)
    summary, _ = drive(scenario_of(config, "main1:main1"), tmp_path / "run")
    assert summary["vehicles"]["on_preferred_lane"] == summary["vehicles"]["demanded"] == 36
    safety = summary["safety"]
    assert safety["overlaps"] == safety["sumo_collisions"] == safety["hard_brakes"] == 0
    found: dict[str, list[tuple[float, float]]] = {"left": [], "ahead": []}
    last = {one["vehicle"]: one["s_m"] for one in read_trajectories(tmp_path / "run").to_pylist()}
    for name, trip in read_trips(tmp_path / "run").items():
        turn = turns[int(trip["sumo_id"][1:]) % 3]
        found[turn].append((last[name], trip["travel_time_s"]))
    # Those that turn left are given back one after another, each farther back than the one before.
    lines_m = [s_m for s_m, _ in found["left"]]
    assert all(behind_m < ahead_m + 5.0 for ahead_m, behind_m in pairwise(lines_m))
    assert lines_m[-1] < lines_m[0] - 150.0
    assert all(s_m > 850.0 for s_m, _ in found["ahead"])
    times_s = [time_s for _, time_s in found["ahead"]]
    assert max(times_s) < 1.15 * min(times_s)


@pytest.mark.more
def test_sumo_drives_into_turn_pockets(tmp_path: Path) -> None:
    turns = ["left", "ahead"]
    vehicles = [vehicle(f"v{n}", n, f"pocket {turns[n % 2]}") for n in range(12)]
    config = write_interchange(tmp_path, vehicles, network=POCKET)
    summary, _ = drive(scenario_of(config, "main1:main2"), tmp_path / "run")
    assert summary["vehicles"]["on_preferred_lane"] == summary["vehicles"]["demanded"] == 12
    assert summary["safety"]["overlaps"] == summary["safety"]["sumo_collisions"] == 0
    arrived = ET.parse(tmp_path / "run" / "tripinfo.xml").getroot()  # noqa: S314 (own file)
    edges = {one.get("id"): str(one.get("arrivalLane")).rpartition("_")[0] for one in arrived}
    assert edges == {f"v{n}": turns[n % 2] for n in range(12)}


@pytest.mark.more
def test_a_vehicle_that_never_comes_to_the_corridor_is_counted(tmp_path: Path) -> None:
    stands = (
        '<vehicle id="stands" type="car" depart="0" departPos="200"><route edges="before"/>'
        '<stop lane="before_0" endPos="220" duration="2000"/></vehicle>'
    )
    vehicles = [stands, vehicle("m", 1.0, "main"), vehicle("r", 5.0, "ramp")]
    summary, _ = drive(scenario(tmp_path, vehicles), tmp_path / "run")
    assert summary["vehicles"]["demanded"] == 2
    assert summary["vehicles"]["entered"] == summary["vehicles"]["left"] == 1
    (waits,) = [one for one in read_trips(tmp_path / "run").values() if one["left_s"] is None]
    assert (waits["sumo_id"], waits["entrance"]) == ("r", "on")


@pytest.mark.more
def test_both_runs_have_the_same_vehicles(tmp_path: Path) -> None:
    """Also where SUMO draws them: flows by probability, districts, trips, stops, a scale."""
    routes = [
        (
            '<flow id="p" type="car" begin="0" end="15" probability="0.3" departLane="free">'
            '<route edges="main1 main2 main3 main4 main5"/></flow>'
        ),
        '<flow id="t" type="car" begin="2" end="12" number="3" fromTaz="A" toTaz="B"/>',
        (
            '<vehicle id="bus" type="car" depart="3"><route edges="main1 main2 main3 main4 main5"/>'
            '<stop lane="main2_1" endPos="100" duration="5"/></vehicle>'
        ),
        '<trip id="u" type="car" depart="4" from="before" to="main5"/>',
    ]
    config = write_interchange(tmp_path, routes, types=TRUCKS)
    districts = '<taz id="A" edges="start"/><taz id="B" edges="off"/>'
    (tmp_path / "taz.xml").write_text(f"<additional>{districts}</additional>", encoding="utf-8")
    text = config.read_text(encoding="utf-8")
    config.write_text(
        text.replace("</input>", '<additional-files value="taz.xml"/></input>'), encoding="utf-8"
    )
    window = TimeWindow(duration_s=15.0, scale=2.0)
    own = parse_scenario(corridor_tables(read_corridor(config, CORRIDOR, window), config, window))
    summary, _ = drive(own, tmp_path / "run")
    assert summary["vehicles"]["left_out"] == {"stop on their way": 2}
    compare(own, tmp_path / "run")
    ours = read_statistics(tmp_path / "run").trips
    alone = read_statistics(tmp_path / "run" / ALONE_FOLDER).trips
    assert ours.keys() == alone.keys()
    assert {name.split(".")[0] for name in ours} == {"p", "t", "u"}
    assert {name: trip.arrival_edge for name, trip in ours.items()} == {
        name: trip.arrival_edge for name, trip in alone.items()
    }


@pytest.mark.more
def test_vehicles_come_from_upstream(tmp_path: Path) -> None:
    """SUMO determines their lanes; some arrive at the same time in different lanes."""
    vehicles = []
    for second in range(0, 50, 2):
        route = "upstream exit" if second % 12 == 4 else "upstream"
        kind = "truck" if second % 10 == 6 else "car"
        vehicles.append(vehicle(f"u{second}", second, route, kind))
        vehicles.append(vehicle(f"v{second}", second, "upstream"))
        if second % 6 == 0:
            vehicles.append(vehicle(f"m{second}", second + 1, "main"))
            vehicles.append(vehicle(f"r{second}", second + 1, "ramp"))
    own = scenario(tmp_path, vehicles)
    summary, events = drive(own, tmp_path / "run")
    count = len(vehicles)
    assert summary["vehicles"]["left"] == summary["vehicles"]["at_destination"] == count
    assert summary["safety"]["overlaps"] == summary["safety"]["sumo_collisions"] == 0
    assert summary["safety"]["min_gap_m"] >= 5.0
    assert {event["kind"] for event in events}.isdisjoint({"missed-exit", "left-lattice"})
    trips = read_trips(tmp_path / "run").values()
    assert {trip["entrance"] for trip in trips} == {MAIN_ENTRANCE, "on"}


@pytest.mark.more
def test_an_exit_follows_a_ramp_in_the_same_lane(tmp_path: Path) -> None:
    """Moves into the lane of the exit begin at different times of their slots, some early."""
    vehicles = []
    for second in range(0, 60, 2):
        kind = "truck" if second % 14 == 6 else "car"
        route = "late exit" if second % 6 == 4 else "main"
        vehicles.append(vehicle(f"{route[-4:]}{second}", second, route, kind))
        if second % 8 == 0:
            vehicles.append(vehicle(f"ramp{second}", second, "early ramp"))
    own = scenario(tmp_path, vehicles, RAMP_FIRST)
    folder = tmp_path / "run"
    summary, events = drive(own, folder)
    assert summary["vehicles"]["left"] == summary["vehicles"]["at_destination"] == len(vehicles)
    assert summary["safety"]["overlaps"] == summary["safety"]["sumo_collisions"] == 0
    assert summary["tracking"]["emergency_ticks"] == 0
    assert {event["kind"] for event in events}.isdisjoint({"missed-exit", "left-lattice"})
    assert hardest_braking_mps2(folder) <= 4.0
    # What SUMO says, too.
    trips = ET.parse(folder / "tripinfo.xml").getroot()  # noqa: S314 (written by SUMO)
    for trip in trips.iter("tripinfo"):
        if not trip.get("vaporized"):
            edge = "off" if trip.attrib["id"].startswith("exit") else "main5"
            assert trip.attrib["arrivalLane"].startswith(f"{edge}_")


@pytest.mark.more
def test_equal_runs_are_equal(tmp_path: Path) -> None:
    own = scenario(tmp_path, stream(8))
    folders = [tmp_path / name for name in ("one", "two")]
    for folder in folders:
        drive(own, folder)
    one, two = (read_trips(folder) for folder in folders)
    assert one == two


@pytest.mark.more
@pytest.mark.parametrize("given_back", [True, False])
def test_a_queue_behind_the_exit_is_braked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, given_back: bool
) -> None:
    """Vehicles are given back before it; if they could not be, they would brake by themselves."""
    monkeypatch.setattr(sumo_statistics, "CONFLICT_S", 5.0)  # so that there are some
    if not given_back:
        monkeypatch.setattr(HandOver, "given_back", lambda *_: ())
    standing = standing_vehicle(22, 25, 'duration="60"')
    leaving = [vehicle(f"e{n}", 4.0 * n, "exit") for n in range(6)]
    own = scenario(tmp_path, [*leaving, standing, vehicle("m", 24.0, "main")])
    summary, _ = drive(own, tmp_path / "run")
    assert summary["safety"]["overlaps"] == summary["safety"]["sumo_collisions"] == 0
    assert summary["vehicles"]["left"] == summary["vehicles"]["at_destination"] == 7
    trips = {trip["sumo_id"]: trip for trip in read_trips(tmp_path / "run").values()}
    # The queue, which begins when all are inside, reaches back into the corridor for 60 s.
    assert all(trips[f"e{n}"]["entered_s"] < 22.0 for n in range(6))
    rows = read_rows(tmp_path / "run")
    names = {trip["sumo_id"]: name for name, trip in read_trips(tmp_path / "run").items()}
    if given_back:
        last_m = max(s_m for (name, _), (s_m, _) in rows.items() if name == names["e5"])
        assert last_m < own.exit[0].at_m - 20.0
        assert summary["safety"]["hard_brakes"] == 0
        return
    assert trips["e5"]["left_s"] > 80.0
    # Times to collision that SUMO reports are those of the recorded trajectories.
    checked = 0
    for one in read_statistics(tmp_path / "run").conflicts:
        tick = round(one.at_s / own.runtime.tick_s)
        keys = [(names.get(name, ""), tick) for name in one.vehicles]
        if not rows.keys() >= {*keys}:
            continue  # SUMO drives one of them
        (rear_m, fast_mps), (front_m, slow_mps) = sorted(rows[key] for key in keys)
        gap_m = front_m - own.vehicle.length_m - rear_m
        # SUMO measures along its lanes, from which bodies are up to some decimetres away.
        assert one.min_ttc_s == pytest.approx(gap_m / (fast_mps - slow_mps), rel=0.1, abs=0.06)
        checked += 1
    assert checked > 0


@pytest.mark.more
def test_a_truck_does_not_brake_hard_behind_one_that_has_left(tmp_path: Path) -> None:
    """The limit behind the exit is lower than v_F, and SUMO slows down for it."""
    seconds = [first + second for first in range(0, 20, 5) for second in (0, 1)]
    leaving = [vehicle(f"t{second}", second, "exit", "truck") for second in seconds]
    own = scenario(tmp_path, leaving)
    assert own.formation.speed_mps > RAMP_SPEED_MPS
    summary, _ = drive(own, tmp_path / "run")
    assert summary["vehicles"]["left"] == summary["vehicles"]["at_destination"] == 8
    assert summary["safety"]["overlaps"] == summary["safety"]["sumo_collisions"] == 0
    assert summary["tracking"]["emergency_ticks"] == 0
    assert hardest_braking_mps2(tmp_path / "run") <= 4.0
    assert read_statistics(tmp_path / "run").collisions == 0


@pytest.mark.more
def test_vehicles_wait_at_the_start_while_their_exit_is_full(tmp_path: Path) -> None:
    """In the corridor they would stop beside the exit, and so would all vehicles behind them."""
    until_s = 100
    blocked = standing_vehicle(0, 45, f'until="{until_s}"')
    own = scenario(tmp_path, [blocked, *stream(60)])
    summary, events = drive(own, tmp_path / "run")
    assert summary["vehicles"]["left"] == summary["vehicles"]["at_destination"] == 70
    assert summary["safety"]["overlaps"] == summary["safety"]["sumo_collisions"] == 0
    assert {event["kind"] for event in events}.isdisjoint(
        {"missed-exit", "left-lattice", "agent-missing"}
    )
    by_exit: dict[str, list[dict[str, Any]]] = {"off": [], "end": []}
    for trip in read_trips(tmp_path / "run").values():
        by_exit[trip["destination"]].append(trip)
    # Only some fit behind the one that stands; the others enter when it has driven on.
    late = [trip for trip in by_exit["off"] if trip["entered_s"] > until_s]
    assert 2 <= len(late) < len(by_exit["off"])
    # Others are not held back, and none is slowed down.
    for trip in by_exit["end"]:
        if trip["entrance"] == MAIN_ENTRANCE:
            assert trip["entered_s"] - trip["demanded_s"] < 3.0
            free_s = own.road.length_m / own.formation.speed_mps
            assert trip["left_s"] - trip["entered_s"] == pytest.approx(free_s, abs=1.5)


@pytest.mark.more
def test_a_run_ends_although_an_exit_remains_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(corridor_setup, "MAX_WAIT_S", 60.0)
    blocked = standing_vehicle(0, 40, 'duration="100000"')
    leaving = [vehicle(f"e{n}", 3.0 * n, "exit") for n in range(9)]
    own = scenario(tmp_path, [blocked, *leaving, vehicle("m", 24.0, "main")])
    summary, events = drive(own, tmp_path / "run")
    assert summary["ending"] == "complete"
    assert summary["vehicles"]["demanded"] == 10
    assert 1 < summary["vehicles"]["entered"] < 10
    assert summary["vehicles"]["left"] == summary["vehicles"]["entered"]
    assert summary["safety"]["overlaps"] == 0
    assert {event["kind"] for event in events}.isdisjoint({"missed-exit", "left-lattice"})
    assert read_statistics(tmp_path / "run").collisions == 0


@pytest.mark.more
def test_flows_on_the_first_edge(tmp_path: Path) -> None:
    """SUMO drives their vehicles for a step, before they are taken out and wait."""
    flow = '<flow id="{0}" type="car" begin="0" end="40" period="{1}" departSpeed="max">'
    flow += '<route edges="main1 main2 {2}"/></flow>'
    ways = ("through", 2, "main3 main4 main5"), ("leaving", 5, "off")
    own = scenario(tmp_path, [*(flow.format(*way) for way in ways), *stream(9)])
    folder = tmp_path / "run"
    summary, events = drive(own, folder)
    assert summary["vehicles"]["left"] == summary["vehicles"]["at_destination"] == 20 + 8 + 11
    assert summary["safety"]["overlaps"] == summary["safety"]["sumo_collisions"] == 0
    assert {event["kind"] for event in events}.isdisjoint({"missed-exit", "agent-missing"})
    routes = compare(own, folder)
    assert sum(one.vehicles for one in routes) == 39
    assert all(one.arrived == (one.vehicles, one.vehicles) for one in routes)
    found = read_statistics(folder)
    assert found.collisions == 0
    trips = read_trips(folder).values()
    assert {trip["sumo_id"] for trip in trips} == found.trips.keys()
