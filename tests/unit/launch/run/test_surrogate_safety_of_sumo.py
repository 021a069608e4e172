"""Times to collision and decelerations equal those of SUMO's own device, in traffic it drives.

SUMO's device knows no post-encroachment times of lane changes, only of paths that cross.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from laneweave.launch.run.reference_run import ReferenceRun
from laneweave.launch.run_methods import LC2013, METHODS
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.sumo import session
from laneweave.sim_bridge.sumo.network import write_network

SCENARIOS = Path(__file__).resolve().parents[4] / "scenarios"
FOLLOWER = "2"
"""SUMO's number of an encounter with a vehicle ahead in the same lane."""
DEVICE = {
    "device.ssm.probability": "1",
    "device.ssm.measures": "TTC DRAC",
    "device.ssm.thresholds": "3 0.1",
    "device.ssm.range": "60",
    "device.ssm.trajectories": "true",
}


@pytest.mark.more
@pytest.mark.parametrize(
    ("road", "volume", "label"),
    [(None, 1600.0, "lc2013"), (None, 1600.0, "lc2013-4s"), ("on-ramp", 1800.0, "lc2013-human")],
)
def test_measures_equal_those_of_sumo(
    road: str | None,
    volume: float,
    label: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def with_device(scenario: Scenario, folder: Path, *, sumo_drives: bool) -> list[str]:
        command = [*write_network(scenario, folder, sumo_drives=sumo_drives)]
        for name, value in DEVICE.items() | {("device.ssm.file", str(tmp_path / "ssm.xml"))}:
            command += [f"--{name}", value]
        return command

    monkeypatch.setattr(session, "write_network", with_device)
    base = load_scenario(
        None if road is None else SCENARIOS / f"{road}.toml",
        seed=3,
        demand__volume_veh_per_lane_h=volume,
        demand__duration_s=200.0,
    )
    scenario = METHODS[label].settings(base)
    outcome = ReferenceRun(scenario, tmp_path / "run", LC2013, show_progress=False).run()
    assert outcome.summary is not None
    found = outcome.summary.safety
    times_s: list[float] = []
    decelerations_mps2: list[float] = []
    for encounter in ET.parse(tmp_path / "ssm.xml").iter("conflict"):  # noqa: S314
        kinds, times, decelerations = (
            encounter.find(name).attrib["values"].split()  # type: ignore[union-attr]
            for name in ("typeSpan", "TTCSpan", "DRACSpan")
        )
        for kind, time_s, drac_mps2 in zip(kinds, times, decelerations, strict=True):
            if kind == FOLLOWER:
                times_s += [float(time_s)] if time_s != "NA" else []
                decelerations_mps2 += [float(drac_mps2)] if drac_mps2 != "NA" else []
    assert found.min_ttc_s == pytest.approx(min(times_s), rel=0.02)
    assert found.drac_max_mps2 == pytest.approx(max(decelerations_mps2), rel=0.02)
    below_s = scenario.runtime.tick_s * sum(time_s < 3.0 for time_s in times_s)
    assert below_s > 1.0
    assert found.ttc_below_3_s == pytest.approx(below_s, rel=0.05)
