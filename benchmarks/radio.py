"""Cost of radio: travel time, lanes and gaps by technology, transmission power and density.

    python benchmarks/radio.py [--only TEXT ...] [--seeds N] [--again]

Each run drives the paper's road with 200 s of arrivals over the simulated network, where results
repeat exactly. The results are in docs/evidence/radio.json; finished runs are not repeated unless
`--again` is given.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, Final

from attrs import field, frozen

from evaluation.markdown import MISSING, markdown, number
from experiments import Job, run_points, silence
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.radio_table import C_V2X, DSRC
from laneweave.protocol.summary import read_summary

OUT: Final = Path(__file__).resolve().parents[1] / "docs" / "evidence"
RECORD: Final = "radio.json"
DURATION_S: Final = 200.0
VOLUME: Final = 1600
OPERATIONS: Final = ("formations", "rolling")
POWER_DBM: Final = 23.0
"""Usual maximum transmission power of vehicle radios."""


HEADINGS: Final = (
    "operation", "sidelink", "dBm", "other senders/km", "runs", "lost by sidelink",
    "lost by cellular", "time", "in their lanes", "smallest gap", "overlaps",
)  # fmt: skip


@frozen
class Point:
    """A radio, and an operation."""

    operation: str
    technology: str | None = None
    """None: no radio."""
    settings: Mapping[str, float] = field(factory=dict)
    """Fields of the table `radio` other than its technology."""
    seeds: int = 1

    @property
    def name(self) -> str:
        """Name of the point in the record."""
        values = (f"{name} {value:g}" for name, value in self.settings.items())
        return " ".join((self.operation, self.technology or "undisturbed", *values))

    def scenario(self, seed: int) -> Scenario:
        """Return the scenario of a run."""
        radio = {f"radio__{name}": value for name, value in self.settings.items()}
        return load_scenario(
            None,
            seed=seed,
            demand__volume_veh_per_lane_h=float(VOLUME),
            demand__duration_s=DURATION_S,
            formation__operation=self.operation,
            tracking__shortcut=True,
            radio__technology=self.technology,
            **radio,
        )


def _points() -> Iterator[Point]:
    """Yield all points."""
    for operation in OPERATIONS:
        yield Point(operation, seeds=3)
        for technology in (C_V2X, DSRC):
            yield Point(operation, technology, {"power_dbm": POWER_DBM}, seeds=3)
            for power_dbm, others in (
                (POWER_DBM, 400.0),
                *((power_dbm, 0.0) for power_dbm in (0.0, -5.0, -10.0)),
                (0.0, 400.0),
            ):
                settings = {"power_dbm": power_dbm, "other_senders_per_km": others}
                yield Point(operation, technology, settings)
        for share, duration_s in ((0.1, 1.0), (0.3, 3.0)):
            settings = {"power_dbm": POWER_DBM, "burst_share": share, "burst_s": duration_s}
            yield Point(operation, C_V2X, settings)


POINTS: Final = tuple(_points())


def drive(job: Job[Point]) -> dict[str, Any]:
    """Drive one run, and return its results."""
    scenario = job.point.scenario(job.seed)
    with tempfile.TemporaryDirectory(prefix="laneweave-radio-") as name, silence():
        folder, began_s = Path(name), time.process_time()
        run = SimulatedRun(scenario, folder, show_progress=False)
        problems = run.run().or_interrupt().problems
        summary = read_summary(folder)
    if summary is None:
        raise RuntimeError(f"{folder}: no summary")
    vehicles, safety, messages = summary.vehicles, summary.safety, summary.messages
    return {
        "point": job.point.name,
        "seed": job.seed,
        "travel_time_s": summary.travel_time_s.mean,
        "demanded": vehicles.demanded,
        "left": vehicles.left,
        "in_another_lane": vehicles.left - (vehicles.on_preferred_lane or 0),
        "overlaps": safety.overlaps,
        "min_gap_m": safety.min_gap_m,
        "min_ttc_s": safety.min_ttc_s,
        "emergency_brakes": safety.emergency_brakes,
        "sidelink_lost": _share(messages.sidelink_lost, messages.sidelink),
        "cellular_lost": _share(messages.cellular_lost, messages.cellular),
        "cpu_s": round(time.process_time() - began_s, 1),
        "problems": list(problems),
    }


def table(record: Path) -> str:
    """Return the table of docs/RADIO.md; runs that are planned but not recorded are `MISSING`."""
    known = json.loads(record.read_text(encoding="utf-8"))
    rows = [_row(point, known) for point in POINTS if point.technology is not None]
    return markdown(HEADINGS, rows)


def _row(point: Point, known: Mapping[str, dict[str, Any]]) -> list[str]:
    """Return the row of a point, over its recorded runs."""
    keys = [_key(point, seed) for seed in range(1, point.seeds + 1)]
    runs = [known[key] for key in keys if key in known]
    sidelink = f"{point.technology}"
    if "burst_share" in point.settings:
        share, burst_s = point.settings["burst_share"], point.settings["burst_s"]
        sidelink += f", bursts of {burst_s:g} s for {100.0 * share:g} % of the time"
    settings = [
        point.operation,
        sidelink,
        f"{point.settings['power_dbm']:g}",
        f"{point.settings.get('other_senders_per_km', 0.0):g}",
        f"{len(runs)}" + (f" of {len(keys)}" if len(runs) < len(keys) else ""),
    ]
    if not runs:
        return [*settings, MISSING, *[""] * (len(HEADINGS) - len(settings) - 1)]
    left = sum(run["left"] for run in runs)
    ratios = [
        run["travel_time_s"] / other["travel_time_s"]
        for run in runs
        if (other := known.get(_key(Point(point.operation), run["seed"]))) is not None
        and None not in (run["travel_time_s"], other["travel_time_s"])
    ]
    stuck = sum(run["demanded"] for run in runs) - left
    off = sum(run["in_another_lane"] for run in runs)
    in_lanes = f"{100.0 * (1.0 - off / left):.1f} %" if left else "-"
    gaps_m = [run["min_gap_m"] for run in runs if run["min_gap_m"] is not None]
    return [
        *settings,
        _percent([run["sidelink_lost"] for run in runs]),
        _percent([run["cellular_lost"] for run in runs]),
        number(fmean(ratios) if ratios else None, 3),
        in_lanes + (f" ({stuck} on the road)" if stuck else ""),
        f"{number(min(gaps_m, default=None), 1)} m",
        f"{sum(run['overlaps'] for run in runs)}",
    ]


def _percent(shares: Sequence[float | None]) -> str:
    """Return the mean of the known shares in percent."""
    known = [share for share in shares if share is not None]
    return f"{100.0 * fmean(known):.1f} %" if known else "-"


def _key(point: Point, seed: int) -> str:
    return Job(point, seed).key


def _share(part: int | None, whole: int | None) -> float | None:
    return None if part is None or not whole else round(part / whole, 4)


if __name__ == "__main__":
    sys.exit(run_points(POINTS, drive, OUT / RECORD, __doc__))
