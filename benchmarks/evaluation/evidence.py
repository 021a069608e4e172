"""docs/evidence/evaluation.json: the data of all tables of the document."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Final

from attrs import asdict, evolve, fields, frozen

from evaluation.points import Key, PointRow, RunRow, points_of_runs
from evaluation.programme import FORMATIONS
from evaluation.trials import AgreementRow, CostRow, FactorRow
from laneweave.launch.recordings.runs import Run
from laneweave.launch.run_methods import rank
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.files import write_atomically
from laneweave.protocol.structuring import structure

SCHEMA: Final = "laneweave.evaluation/2"


@frozen
class Setting:
    """The settings of all points of the sweep."""

    duration_s: float
    """Duration of the arrivals."""
    road_m: float
    free_flow_s: float
    """Travel time at v_F."""
    pitch_m: float
    """d_F."""
    speed_mps: float
    """v_F."""
    min_accel_mps2: float
    max_accel_mps2: float


@frozen
class Picture:
    """A figure of the document."""

    name: str
    """Name of its file in docs/images."""
    alt: str
    caption: str


@frozen
class Evidence:
    """All measurements; missing ones are empty."""

    schema: str = SCHEMA
    setting: Setting | None = None
    runs: tuple[RunRow, ...] = ()
    pictures: tuple[Picture, ...] = ()
    agreements: tuple[AgreementRow, ...] = ()
    factors: tuple[FactorRow, ...] = ()
    costs: tuple[CostRow, ...] = ()

    @cached_property
    def points(self) -> tuple[PointRow, ...]:
        """The runs by label and volume, over their seeds."""
        return points_of_runs(self.runs)

    @cached_property
    def by_key(self) -> dict[Key, PointRow]:
        """The points by label and volume."""
        return {(row.label, row.volume_veh_per_lane_h): row for row in self.points}

    def updated_with(self, new: Evidence, *, add_runs: bool = False) -> Evidence:
        """Return a copy in which the parts of newer evidence replace the present ones.

        Runs replace those of the same labels, and figures all others; with `add_runs`, only runs of
        the same volumes and seeds, and figures of the same names.

        Raises:
            BadInputError: runs of other labels have another setting.
        """
        kept = self
        if new.runs:
            labels = {row.label for row in new.runs}
            replaced = {(*row.key, row.seed) for row in new.runs}
            others = [
                row
                for row in self.runs
                if row.label not in labels or (add_runs and (*row.key, row.seed) not in replaced)
            ]
            if others and new.setting != self.setting:
                names = ", ".join(sorted({row.label for row in others}))
                raise BadInputError("setting", new.setting, f"{self.setting}, as for {names}")
            runs = sorted([*others, *new.runs], key=_order)
            pictures = (*self.pictures, *new.pictures) if add_runs else new.pictures
            by_name = {picture.name: picture for picture in pictures}
            kept = evolve(
                kept, setting=new.setting, runs=tuple(runs), pictures=tuple(by_name.values())
            )
        return evolve(
            kept,
            agreements=new.agreements or kept.agreements,
            factors=new.factors or kept.factors,
            costs=new.costs or kept.costs,
        )


def _order(row: RunRow) -> tuple[int, str, float, int]:
    return (*rank(row.label), row.volume_veh_per_lane_h, row.seed)


def setting_of(runs: Sequence[Run]) -> Setting:
    """Return the settings that runs share, read from the first run of formation control."""
    scenario = next((run for run in runs if run.label in FORMATIONS), runs[0]).scenario
    formation, vehicle = scenario.formation, scenario.vehicle
    return Setting(
        duration_s=scenario.demand.duration_s,
        road_m=scenario.road.length_m,
        free_flow_s=round(scenario.geometry.free_flow_s, 3),
        pitch_m=formation.gap_m,
        speed_mps=formation.speed_mps,
        min_accel_mps2=vehicle.min_accel_mps2,
        max_accel_mps2=vehicle.max_accel_mps2,
    )


def read_evidence(path: Path) -> Evidence:
    """Return the recorded evidence; empty if there is no file.

    Raises:
        BadInputError: the file has an unknown format.
        ValueError: the file is not JSON.
    """
    if not path.is_file():
        return Evidence()
    found = json.loads(path.read_text(encoding="utf-8"))
    if found.get("schema") != SCHEMA:
        raise BadInputError(f"{path}: schema", found.get("schema"), SCHEMA)
    names = found.pop("columns", [])
    rows = [dict(zip(names, row, strict=True)) for row in found["runs"]]
    return structure(found | {"runs": rows}, Evidence)


def write_evidence(evidence: Evidence, path: Path) -> None:
    """Write the evidence atomically, with one line for each run."""
    found = asdict(evidence)
    runs = found.pop("runs")
    names = [own.name for own in fields(RunRow)]
    lines = ",\n".join(json.dumps([run[name] for name in names]) for run in runs)
    head = json.dumps(found | {"columns": names}, indent=1).removesuffix("\n}")
    write_atomically(path, f'{head},\n "runs": [\n{lines}\n ]\n}}\n')
