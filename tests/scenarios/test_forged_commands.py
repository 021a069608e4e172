"""Whatever agents command, by mistake or intent, no bodies overlap and the road goes on."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest
from attrs import evolve

from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Name
from support.forged_commands import ForgedRun, Forger
from support.paper import PAPER

SCENARIOS = Path(__file__).parents[2] / "scenarios"
ROADS = ("paper", "on-ramp", "weaving", "lane-drop", "blocked-lane", "trucks", "off-ramp")
ATTACKS_PER_SENSE = 0.01
MAX_ROAD_S = 200.0
"""A road on which vehicles are attacked may take long to empty."""


def road(name: str, seed: int, demand_s: float, *, operation: str | None = None) -> Scenario:
    scenario = load_scenario(SCENARIOS / f"{name}.toml")
    formation = scenario.formation
    return evolve(
        scenario,
        seed=seed,
        demand=evolve(scenario.demand, duration_s=demand_s),
        runtime=evolve(scenario.runtime, max_road_s=MAX_ROAD_S),
        formation=evolve(formation, operation=operation or formation.operation),
    )


@pytest.mark.parametrize(
    ("name", "operation", "seed"),
    [
        pytest.param("paper", None, 0, marks=pytest.mark.more),
        pytest.param("paper", "rolling", 0, marks=pytest.mark.more),
        pytest.param("weaving", None, 0, marks=pytest.mark.more),
        *(
            pytest.param(name, operation, seed, marks=pytest.mark.full)
            for seed in range(1, 10)
            for name, operation in (*((name, None) for name in ROADS), ("paper", "rolling"))
        ),
    ],
)
def test_forged_commands_make_no_bodies_overlap(
    tmp_path: Path, name: str, operation: str | None, seed: int
) -> None:
    scenario = road(name, seed, 20.0, operation=operation)
    forger = Forger(scenario, random.Random(seed), ATTACKS_PER_SENSE)
    outcome = ForgedRun(scenario, tmp_path / "run", show_progress=False, forger=forger).run()
    assert outcome.summary is not None
    safety = outcome.summary.safety
    assert (safety.overlaps, safety.sumo_collisions) == (0, 0), forger.attacks
    assert forger.commands > 2000
    assert safety.commands_refused is not None
    assert safety.commands_refused > 100


def with_gap(scenario: Scenario) -> Scenario:
    return evolve(scenario, formation=evolve(scenario.formation, gap_m=10.0))


def faster(scenario: Scenario) -> Scenario:
    return evolve(scenario, formation=evolve(scenario.formation, speed_mps=18.0))


def wider(scenario: Scenario) -> Scenario:
    return evolve(scenario, road=evolve(scenario.road, lane_width_m=5.0))


def stronger(scenario: Scenario) -> Scenario:
    vehicle = evolve(scenario.vehicle, max_accel_mps2=9.0, max_lateral_accel_mps2=8.0)
    return evolve(scenario, vehicle=vehicle)


@pytest.mark.parametrize(
    "mistake",
    [
        pytest.param(wider, marks=pytest.mark.more),
        *(pytest.param(one, marks=pytest.mark.full) for one in (with_gap, faster, stronger)),
    ],
)
def test_a_fleet_that_is_configured_for_another_road_endangers_nobody(
    tmp_path: Path, mistake: Callable[[Scenario], Scenario]
) -> None:
    """Half of the vehicles have agents of this fleet."""
    scenario = evolve(PAPER, demand=evolve(PAPER.demand, volume_veh_per_lane_h=1300.0))
    scenario = evolve(scenario, demand=evolve(scenario.demand, duration_s=20.0))
    other = mistake(scenario)

    def scenario_of(vehicle: Name) -> Scenario:
        return other if int(vehicle[1:]) % 2 else scenario

    run = ForgedRun(scenario, tmp_path / "run", show_progress=False, mistaken=scenario_of)
    outcome = run.run()
    assert outcome.problems == ()
    assert outcome.summary is not None
    assert outcome.summary.safety.overlaps == 0
    assert outcome.summary.safety.commands_refused or mistake is stronger
    assert outcome.summary.vehicles.left == outcome.summary.vehicles.demanded
