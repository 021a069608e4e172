"""Results of the stream planner: `python benchmarks/stream.py [--volumes V ...] [--seeds N]`.

A lattice without faults. Arrivals are those of a scenario; each vehicle enters the free column that
is nearest to its arrival, behind its predecessor in the lane. In each slot all vehicles on the road
are planned, and the first step of every path is made. CPU time of one thread.

Vehicles of some variants come from a ramp, at `RAMP_M` in lane 0, and some leave by an exit.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from attrs import field, frozen

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.geometry.conflict_table import conflict_table
from laneweave.coordinator.planning.geometry.swept_bodies import BodyGeometry
from laneweave.coordinator.planning.kernels import ROLLING
from laneweave.coordinator.planning.rolling.path_search import StreamPlanner
from laneweave.coordinator.planning.rolling.problem import (
    StreamCosts,
    StreamPlan,
    StreamRoad,
    StreamVehicle,
)
from laneweave.coordinator.planning.rolling.rolling_validator import problems_of_plan
from laneweave.coordinator.rolling.checked_planner import REWARD, stream_road
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.road_layout import LaneSection
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.road.demand import arrivals

OUT = Path(__file__).resolve().parents[1] / "docs" / "evidence" / "stream.json"
VOLUMES = (1000, 1600, 1800, 2000, 2200, 2400, 2500, 2600)
DURATION_S, NOT_COUNTED_S = 600.0, 60.0


def _rolling(**more: object) -> Scenario:
    """Return the scenario of the rolling operation; see `load_scenario`."""
    return load_scenario(None, formation__operation="rolling", **more)


SCENARIO = _rolling(formation__cycle_s=4.0)
SPEED_MPS, ROAD = SCENARIO.formation.speed_mps, stream_road(SCENARIO)
PITCH_M, LENGTH_M = ROAD.pitch_m, ROAD.length_m


RAMP_M, JOINS_M, OFF_M = 300.0, 400.0, 700.0
"""Where vehicles enter a ramp, where its lane joins the road, and where this lane ends."""


@frozen
class Variant:
    """A road, costs and volumes to measure."""

    road: StreamRoad = ROAD
    costs: StreamCosts = field(factory=StreamCosts)
    volumes: tuple[int, ...] = (1800, 2400, 2600)
    ramp_veh_h: float = 0.0
    """Flow [vehicles/h] from the ramp."""
    leaving_veh_h: float = 0.0
    """Flow [vehicles/h] from the start of the road to the exit."""

    @property
    def sorts(self) -> bool:
        """Whether each lane has an exit of its own, so that vehicles have preferred lanes."""
        return len({section.exit for section in self.road.sections}) == self.road.lanes

    def exits(self, name: str) -> frozenset[int]:
        """Return the sections that lead to an exit."""
        sections = enumerate(self.road.sections)
        return frozenset(number for number, section in sections if section.exit == name)


def _road(*sections: LaneSection, main: int, cycle_s: float = 6.0) -> StreamRoad:
    """Return a road with main lanes from end to end, to the left of the given sections."""
    first = 1 + max(section.lane for section in sections)
    through = [LaneSection(first + lane, to_m=LENGTH_M, exit="end") for lane in range(main)]
    return attrs.evolve(
        ROAD,
        lanes=first + main,
        advance_m=SPEED_MPS * cycle_s,
        sorting_m=(150.0, LENGTH_M),
        sections=(*sections, *through),
    )


_MERGE = LaneSection(0, JOINS_M, OFF_M)
_WEAVE = LaneSection(0, JOINS_M, OFF_M, exit="off")


VARIANTS = {
    "default": Variant(volumes=VOLUMES),
    **{
        f"T_F {cycle_s:g} s": Variant(
            stream_road(_rolling(formation__cycle_s=cycle_s)), volumes=(2000, 2200, 2400)
        )
        for cycle_s in (4.6, 5.0, 5.4, 6.0)
    },
    "S2 too": Variant(stream_road(_rolling(formation__cycle_s=4.0, formation__sort_in_s2=True))),
    "drift rewarded": Variant(costs=StreamCosts(forward=REWARD)),
    "drift free": Variant(costs=StreamCosts(forward=0.0)),
    "trains": Variant(attrs.evolve(ROAD, model=ConflictModel(("node", "edge", "closing")))),
    "0.5 s late": Variant(
        attrs.evolve(
            ROAD,
            model=ConflictModel(
                ("geometric", "closing"), conflict_table(BodyGeometry(lateness_s=0.5))
            ),
        )
    ),
    "mode 2": Variant(attrs.evolve(ROAD, mode=2, model=ConflictModel(("geometric", "closing")))),
    "lane drop": Variant(
        _road(LaneSection(0, to_m=800.0), main=2), volumes=(1000, 1500, 2000, 2200)
    ),
    "blocked lane": Variant(
        _road(LaneSection(0, to_m=500.0), LaneSection(0, 600.0, LENGTH_M, exit="end"), main=2),
        volumes=(1000, 1450, 2000),
    ),
    "on-ramp": Variant(_road(_MERGE, main=3), volumes=(1600, 2000, 2300), ramp_veh_h=800.0),
    "off-ramp": Variant(_road(_WEAVE, main=3), volumes=(2000,), leaving_veh_h=1200.0),
    "weaving": Variant(
        _road(_WEAVE, main=3), volumes=(1600, 2000), ramp_veh_h=600.0, leaving_veh_h=600.0
    ),
    **{
        f"weaving, T_F {cycle_s:g} s": Variant(
            _road(_WEAVE, main=3, cycle_s=cycle_s),
            volumes=(2400,),
            ramp_veh_h=800.0,
            leaving_veh_h=800.0,
        )
        for cycle_s in (6.0, 5.0)
    },
}


@frozen
class Traveller:
    """A vehicle of the demand and the cell in which it enters."""

    vehicle: str
    column: int
    lane: int
    targets: frozenset[int]
    arrival_s: float
    entry_m: float = 0.0

    @property
    def delay_s(self) -> float:
        """Delay on the whole road of a vehicle that stays in its column."""
        return (self.entry_m - PITCH_M * self.column) / SPEED_MPS - self.arrival_s


def travellers(variant: Variant, volume: float, seed: int, duration_s: float) -> list[Traveller]:
    """Return the vehicles by time of entry, each with the free column nearest to its arrival.

    At time 0, column c is at c PITCH_M.
    """
    main_lanes = len({section.lane for section in variant.road.sections if section.from_m < 0.0})
    rng = np.random.default_rng((seed, 1))
    off_share = variant.leaving_veh_h / (main_lanes * volume)

    def entering(
        demand: Scenario, name: str, first_lane: int, entry_m: float
    ) -> Iterator[Traveller]:
        last: dict[int, int] = {}
        for one in arrivals(demand):
            column = round((entry_m - one.t_s * SPEED_MPS) / PITCH_M)
            column = min(column, last.get(one.lane, column + 1) - 1)
            last[one.lane] = column
            if variant.sorts:
                targets = frozenset({one.preferred_lane})
            else:
                leaves = entry_m == 0.0 and rng.random() < off_share
                targets = variant.exits("off" if leaves else "end")
            lane = first_lane + one.lane
            yield Traveller(name + one.vehicle, column, lane, targets, one.t_s, entry_m)

    demand = _demand(main_lanes, volume, seed, duration_s)
    found = [*entering(demand, "", variant.road.lanes - main_lanes, 0.0)]
    if variant.ramp_veh_h:
        demand = _demand(1, variant.ramp_veh_h, seed + 1000, duration_s)
        found += entering(demand, "ramp-", 0, RAMP_M)
    return sorted(found, key=lambda one: one.entry_m - PITCH_M * one.column)


def _demand(lanes: int, volume: float, seed: int, duration_s: float) -> Scenario:
    """Return a scenario with the arrivals of an entrance."""
    return load_scenario(
        None,
        seed=seed,
        road__lanes=lanes,
        demand__volume_veh_per_lane_h=float(volume),
        demand__duration_s=duration_s,
    )


@frozen
class Slot:
    """Figures of the plan of one slot."""

    cpu_ms: float
    check_ms: float
    """CPU time of the validator."""
    rounds: int
    missed: int
    vehicles: int


@frozen
class Departed:
    """A vehicle that has left the road, by the end of a section."""

    traveller: Traveller
    column: int
    section: int
    end_m: float

    @property
    def drift(self) -> int:
        """Columns gained."""
        return self.column - self.traveller.column

    @property
    def delay_s(self) -> float:
        """Excess of the travel time over that at v_F."""
        return self.traveller.delay_s - PITCH_M * self.drift / SPEED_MPS

    @property
    def travel_s(self) -> float:
        """Time from the arrival to the end of the section."""
        return self.delay_s + (self.end_m - self.traveller.entry_m) / SPEED_MPS


class Run:
    """A simulation of the lattice, slot by slot."""

    def __init__(self, variant: Variant, volume: float, seed: int, duration_s: float) -> None:
        """Prepare the first slot."""
        self.road = variant.road
        self.planner = StreamPlanner(variant.road, variant.costs, seed)
        self.coming = travellers(variant, volume, seed, duration_s)[::-1]
        self.on_road: dict[str, tuple[Traveller, tuple[int, int]]] = {}
        self.plan: StreamPlan | None = None
        self.number = 0
        self.left: list[Departed] = []
        self.slots: list[Slot] = []

    def step(self) -> bool:
        """Plan and execute a slot; return whether vehicles remain."""
        front_m = self.number * self.road.advance_m
        while self.coming:
            one = self.coming[-1]
            if one.column * PITCH_M + front_m < one.entry_m:
                break
            self.on_road[one.vehicle] = one, (one.column, one.lane)
            self.coming.pop()
        for name, (one, cell) in list(self.on_road.items()):
            section = self.road.section_at(self.number, cell)
            if section is not None and self.road.has_left(self.number, cell):
                self.left.append(Departed(one, cell[0], section[2], section[1]))
                del self.on_road[name]
        vehicles = [StreamVehicle(v, cell, one.targets) for v, (one, cell) in self.on_road.items()]
        began = time.thread_time()
        plan = self.planner.plan(self.number, vehicles, self.plan)
        cpu_ms = (time.thread_time() - began) * 1e3
        wrong = problems_of_plan(self.road, plan, vehicles)
        check_ms = (time.thread_time() - began) * 1e3 - cpu_ms
        if wrong:
            raise RuntimeError("; ".join(wrong))
        self.slots.append(Slot(cpu_ms, check_ms, plan.rounds, len(plan.missed), len(vehicles)))
        for name, (one, cell) in self.on_road.items():
            path = plan.paths[name]
            self.on_road[name] = one, path[1] if len(path) > 1 else cell
        self.plan = plan
        self.number += 1
        return bool(self.coming or self.on_road)


def measured(name: str, volume: int, seeds: int, duration_s: float) -> dict[str, Any]:
    """Return the results of a volume over some seeds."""
    left: list[Departed] = []
    slots: list[Slot] = []
    off = []
    for seed in range(1, seeds + 1):
        run = Run(VARIANTS[name], volume, seed, duration_s)
        while run.step():
            pass
        counted = [one for one in run.left if one.traveller.arrival_s >= NOT_COUNTED_S]
        off.append(sum(one.section not in one.traveller.targets for one in counted))
        left += counted
        slots += run.slots
    through = [one for one in left if one.traveller.entry_m == 0.0 and one.end_m >= LENGTH_M]
    travel_s = np.array([one.travel_s for one in through])
    from_ramp_s = [one.delay_s for one in left if one.traveller.entry_m > 0.0]
    drift = np.array([one.drift for one in left])
    cpu_ms = np.array([slot.cpu_ms for slot in slots])
    rounds = np.array([slot.rounds for slot in slots])
    return {
        "variant": name,
        "volume_veh_per_lane_h": volume,
        "seeds": seeds,
        "vehicles": len(left),
        "off_lane": sum(off),
        "off_lane_by_seed": off,
        "on_lane_percent": round(100.0 * (1.0 - sum(off) / len(left)), 3),
        "travel_s_mean": round(float(travel_s.mean()), 2),
        "travel_s_p95": round(float(np.percentile(travel_s, 95)), 2),
        "delay_s_mean": round(float(travel_s.mean()) - LENGTH_M / SPEED_MPS, 2),
        "ramp_delay_s_mean": round(float(np.mean(from_ramp_s)), 2) if from_ramp_s else None,
        "drift_columns_mean": round(float(drift.mean()), 3),
        "drifted_percent": round(100.0 * float((drift != 0).mean()), 1),
        "slots": len(slots),
        "vehicles_on_road_max": max(slot.vehicles for slot in slots),
        "slots_with_missed_percent": round(
            100.0 * float(np.mean([s.missed > 0 for s in slots])), 1
        ),
        "rounds_mean": round(float(rounds.mean()), 1),
        "cpu_ms_mean": round(float(cpu_ms.mean()), 2),
        "cpu_ms_p50": round(float(np.percentile(cpu_ms, 50)), 2),
        "cpu_ms_p99": round(float(np.percentile(cpu_ms, 99)), 1),
        "check_ms_mean": round(float(np.mean([slot.check_ms for slot in slots])), 2),
        "check_ms_max": round(max(slot.check_ms for slot in slots), 2),
        "cpu_ms_max": round(float(cpu_ms.max()), 1),
    }


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield one row for each variant and volume."""
    for name in options.variants or VARIANTS:
        for volume in options.volumes or VARIANTS[name].volumes:
            yield measured(name, volume, options.seeds, options.duration)


_SHOWN = (
    "on_lane_percent",
    "travel_s_mean",
    "ramp_delay_s_mean",
    "drift_columns_mean",
    "rounds_mean",
    "cpu_ms_mean",
    "cpu_ms_p50",
    "cpu_ms_p99",
    "cpu_ms_max",
    "check_ms_max",
)


def main() -> None:
    """Measure, print rows, and replace them in a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--volumes", type=int, nargs="+", help="veh/(lane*h); default: all")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, help="default: all")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds; default 5")
    parser.add_argument(
        "--duration", type=float, default=DURATION_S, help="duration of the arrivals [s]"
    )
    parser.add_argument("--json", type=Path, default=OUT, help="output file")
    options = parser.parse_args()
    ROLLING.load()
    results = {}
    if options.json.exists():
        rows_before = json.loads(options.json.read_text(encoding="utf-8"))
        results = {(row["variant"], row["volume_veh_per_lane_h"]): row for row in rows_before}
    sys.stdout.write(f"{'variant':15} volume  off of      {' '.join(_SHOWN)}\n")
    for row in rows(options):
        results[row["variant"], row["volume_veh_per_lane_h"]] = row
        shown = " ".join(f"{row[key]!s:>{len(key)}}" for key in _SHOWN)
        head = f"{row['variant']:15} {row['volume_veh_per_lane_h']:6} {row['off_lane']:4}"
        sys.stdout.write(f"{head} of {row['vehicles']:5} {shown}\n")
        sys.stdout.flush()
    options.json.write_text(json.dumps([*results.values()], indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
