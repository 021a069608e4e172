"""Energy and emissions of runs equal what SUMO reports itself."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from laneweave.launch.recordings import energy
from laneweave.launch.recordings.energy import MODELS, energy_of
from laneweave.launch.recordings.files import TRAJECTORIES_FILE
from laneweave.launch.run.reference_run import ReferenceRun
from laneweave.launch.run_methods import LC2013
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import EnergyFigures
from laneweave.sim_bridge.recording.trips import metadata_of
from laneweave.sim_bridge.sumo import session
from laneweave.sim_bridge.sumo.network import write_network

TICK_S = Scenario().runtime.tick_s


def write_run(folder: Path, speeds_mps: list[float], accels_mps2: list[float]) -> None:
    """Write what is read of a run: the scenario, and speeds and accelerations."""
    columns = {"speed_mps": speeds_mps, "accel_mps2": accels_mps2}
    table = pa.table({name: pa.array(own, pa.float32()) for name, own in columns.items()})
    schema = table.schema.with_metadata(metadata_of(Scenario()))
    pq.write_table(table.cast(schema), folder / TRAJECTORIES_FILE)


@pytest.mark.parametrize("model", ["HBEFA4/PC_petrol_Euro-4", "HBEFA4/PC_BEV"])
def test_energy_equals_that_of_a_run_in_sumo(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SUMO drives, and writes the emissions of each vehicle at each tick."""
    output = tmp_path / "emissions.xml"

    def with_emissions(scenario: Scenario, folder: Path, *, sumo_drives: bool) -> list[str]:
        command = [*write_network(scenario, folder, sumo_drives=sumo_drives)]
        for file in folder.iterdir():
            if "<vType" in (text := file.read_text(encoding="utf-8")):
                file.write_text(text.replace("<vType", f'<vType emissionClass="{model}"'))
        return [*command, "--emission-output", str(output)]

    monkeypatch.setattr(session, "write_network", with_emissions)
    scenario = load_scenario(None, demand__duration_s=40.0)
    ReferenceRun(scenario, tmp_path, LC2013, show_progress=False).run()
    total, driven_m = dict.fromkeys(("CO2", "NOx", "fuel", "electricity"), 0.0), 0.0
    for tick in ET.parse(output).getroot():  # noqa: S314
        for vehicle in tick:
            assert vehicle.attrib["eclass"] == model
            driven_m += TICK_S * float(vehicle.attrib["speed"])
            for name in total:
                total[name] += TICK_S * float(vehicle.attrib[name])
    found = (energy_of(tmp_path, {"own": model}) or {})["own"]
    expected = EnergyFigures(
        model=model,
        co2_g_per_km=total["CO2"] / driven_m,
        nox_mg_per_km=1000.0 * total["NOx"] / driven_m,
        fuel_g_per_km=total["fuel"] / driven_m,
        electricity_wh_per_km=1000.0 * total["electricity"] / driven_m,
    )
    assert driven_m > 20_000.0
    for name in ("co2_g_per_km", "nox_mg_per_km", "fuel_g_per_km", "electricity_wh_per_km"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=0.01)


def test_rows_are_read_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    write_run(tmp_path, rng.uniform(0, 20, 100).tolist(), rng.uniform(-3, 2, 100).tolist())
    whole = energy_of(tmp_path)
    monkeypatch.setattr(energy, "ROWS_AT_ONCE", 7)
    parts = energy_of(tmp_path)
    assert whole is not None
    assert parts is not None
    assert {*whole} == {*MODELS}
    for name, own in whole.items():
        assert parts[name].co2_g_per_km == pytest.approx(own.co2_g_per_km, rel=1e-4)
    assert whole["petrol"].fuel_g_per_km > 0.0 == whole["petrol"].electricity_wh_per_km
    assert whole["electric"].electricity_wh_per_km > 0.0 == whole["electric"].co2_g_per_km


def test_without_movement_there_are_no_figures(tmp_path: Path) -> None:
    write_run(tmp_path, [0.0, 0.0], [0.0, 0.0])
    assert energy_of(tmp_path) is None


@pytest.mark.parametrize(
    ("models", "message"),
    [
        (MODELS, "emission model HBEFA4/PC_petrol_Euro-6d: .*CO2.* is not finite"),
        ({"own": "HBEFA4/PC_steam"}, "emission model HBEFA4/PC_steam: .*not found"),
    ],
)
def test_models_are_refused_by_name(models: dict[str, str], message: str, tmp_path: Path) -> None:
    write_run(tmp_path, [15.0], [np.inf])
    with pytest.raises(CommandFailedError, match=message):
        energy_of(tmp_path, models)


def test_unreadable_trajectories_are_refused(tmp_path: Path) -> None:
    write_run(tmp_path, [15.0], [0.0])
    data = (tmp_path / TRAJECTORIES_FILE).read_bytes()
    (tmp_path / TRAJECTORIES_FILE).write_bytes(data[:100] + bytes(50) + data[150:])
    with pytest.raises(BadInputError):
        energy_of(tmp_path)


def test_without_the_program_there_are_no_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    write_run(tmp_path, [15.0], [0.0])
    assert energy_of(tmp_path) is None
