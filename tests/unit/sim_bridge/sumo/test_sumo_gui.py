"""sumo-gui beside a running simulation; here `sumo`, which shows nothing, takes its place."""

from __future__ import annotations

import subprocess
from functools import partial
from pathlib import Path

import pytest
import traci

from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.sumo import simulation
from laneweave.sim_bridge.sumo.simulation import SumoGui
from laneweave.sim_bridge.sumo.sumo_world import SumoWorld

SCENARIO = Scenario()
TICK_S = SCENARIO.runtime.tick_s


@pytest.fixture(autouse=True)
def no_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulation, "SumoGui", partial(SumoGui, program="sumo"))


def test_the_window_shows_what_is_on_the_road(tmp_path: Path) -> None:
    with SumoWorld(SCENARIO, tmp_path) as world:
        world.show(TICK_S)
        shown = traci.getConnection("laneweave-gui")
        for tick in range(3):
            for number, name in enumerate(["a", "b"]):
                state = (50.0 + 30.0 * number + 1.5 * tick, 15.0, 0.0, 1.75, 0.0, 0.0)
                (world.add if tick == 0 else world.place)(name, state)
            world.step()
            for name in ("a", "b"):
                assert shown.vehicle.getPosition(name) == pytest.approx(
                    world.vehicle.getPosition(name), abs=0.1
                )
                assert shown.vehicle.getLength(name) == SCENARIO.vehicle.length_m
        world.remove("a")
        for _ in range(2):
            world.step()
        assert shown.vehicle.getIDList() == ("b",)


def test_the_run_goes_on_when_the_window_is_closed(tmp_path: Path) -> None:
    with SumoWorld(SCENARIO, tmp_path) as world:
        world.show(TICK_S)
        world.add("a", (50.0, 15.0, 0.0, 1.75, 0.0, 0.0))
        world.step()
        window = traci.getConnection("laneweave-gui")._process
        assert isinstance(window, subprocess.Popen)
        window.kill()
        for _ in range(3):
            world.step()
        assert world.vehicle.getIDList() == ("a",)


def test_a_window_is_closed_once_it_refuses_a_vehicle(tmp_path: Path) -> None:
    with SumoWorld(SCENARIO, tmp_path) as world:
        world.show(TICK_S)
        world.add("a", (50.0, 15.0, 0.0, 1.75, 0.0, 0.0))
        world.step()
        shown = traci.getConnection("laneweave-gui")
        window = shown._process
        assert isinstance(window, subprocess.Popen)
        shown.vehicle.remove("a")
        world.step()
        assert window.wait(10.0) is not None
        world.step()


def test_another_run_of_the_process_has_a_window_too(tmp_path: Path) -> None:
    for _ in range(2):
        with SumoWorld(SCENARIO, tmp_path) as world:
            world.show(TICK_S)
            world.step()
            traci.getConnection("laneweave-gui")._process.kill()
            for _ in range(2):
                world.step()


def test_without_sumo_gui_a_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with (
        SumoWorld(SCENARIO, tmp_path) as world,
        pytest.raises(CommandFailedError, match=r"laneweave\[gui\]"),
    ):
        world.show(TICK_S)
