"""Propagation of a speed disturbance: `python benchmarks/stability.py [--json FILE]`.

One vehicle brakes for 2 s regardless of its commands, in a column that holds its cells, in
formations that switch and in the rolling operation, with and without message loss
(`tests/support/disturbances.py`). Writes peaks and amplification from vehicle to vehicle to a file,
draws a figure, and prints a table. The exit status is 1 if bodies overlap.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import structlog
from attrs import evolve
from numpy.typing import NDArray

if __name__ == "__main__":  # run as a program: as `pythonpath` in pyproject.toml
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from laneweave.launch.drawing.figures import new_figure, save
from support.disturbances import BRAKING_S, FORMATIONS, Case, Response, respond

DOCS = Path(__file__).resolve().parents[1] / "docs"
OUT = DOCS / "evidence" / "stability.json"
FIGURE = DOCS / "images" / "stability.png"
DROPS_MPS = {
    "column": (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0),
    "switching": (0.0, 3.0, 6.0, 8.0),
    "rolling": (0.0, 3.0, 6.0, 8.0),
}
VEHICLES = {"column": 12, "switching": 18, "rolling": 18}
LOSSES = (0.0, 0.5)
SEEDS = 5
DISTURBED_MPS = 0.5
"""Speed error beyond which a vehicle counts as disturbed; undisturbed runs stay below 0.35."""
SHOWN_S = 15.0
"""Time axis of the drawn cases."""
QUANTITIES = ("speed_mps", "gap_m", "accel_mps2")
SHOWN = (
    Case("column", 4.0),
    Case("column", 8.0, 0.5),
    Case("rolling", 8.0, 0.5, vehicles=VEHICLES["rolling"]),
)
"""Cases whose speeds are drawn over time."""
DRAWN_MPS = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0)
COLOURS = ("#9aa0a6", "#56b4e9", "#0072b2", "#e69f00", "#d55e00", "#000000")


def cases() -> list[Case]:
    """Return all cases with the first seed."""
    return [
        Case(formation, drop_mps, loss, vehicles=VEHICLES[formation])
        for formation in FORMATIONS
        for drop_mps in DROPS_MPS[formation]
        for loss in LOSSES
    ]


def peaks(response: Response, quantity: str) -> NDArray[np.float64]:
    """Return the largest absolute value of a quantity, by vehicle."""
    values: NDArray[np.float64] = np.abs(getattr(response, quantity)).max(axis=0)
    return values


def row(case: Case, responses: Sequence[Response]) -> dict[str, Any]:
    """Return the figures of a case: maxima over its runs, by vehicle for some quantities."""
    vehicles = min(response.speed_mps.shape[1] for response in responses)
    found = {
        name: np.array([peaks(one, name)[:vehicles] for one in responses]) for name in QUANTITIES
    }
    speeds = found["speed_mps"]
    in_line = case.formation == "column"
    # In other formations the vehicle ahead in the lane changes.
    ahead = speeds[:, :-1] if in_line else np.maximum.accumulate(speeds[:, :-1], axis=1)
    ratios = np.where(speeds[:, 1:] > DISTURBED_MPS, speeds[:, 1:] / ahead, np.nan)
    return {
        "formation": case.formation,
        "drop_mps": case.drop_mps,
        "loss": case.loss,
        "runs": len(responses),
        **{name: values.max(axis=0).round(3).tolist() for name, values in found.items()},
        "amplification": [
            round(float(np.nanmax(column)), 3) if np.isfinite(column).any() else None
            for column in ratios.T
        ],
        "travelled": int((speeds[:, 1:].max(axis=1) > DISTURBED_MPS).sum()),
        "reached_last": int((speeds[:, -1] > DISTURBED_MPS).sum()),
        "back_s": round(max(one.back_s for one in responses), 1),
        "least_gap_m": round(min(one.least_gap_m for one in responses), 2),
        "overlaps": sum(one.overlaps for one in responses),
        "braked": sum(one.braked for one in responses),
        "moves": sum(one.moves for one in responses),
    }


def draw(runs: Mapping[Case, Sequence[Response]], table: Sequence[dict[str, Any]]) -> None:
    """Draw speeds over time for some cases, and the largest errors of all columns."""
    figure = new_figure(10.0, 6.6)
    *over_time, last = figure.subplots(2, 2).flat
    for axes, shown in zip(over_time, SHOWN, strict=True):
        response = runs[shown][0]
        vehicles = response.speed_mps.shape[1]
        for number in reversed(range(vehicles)):
            colour = str(0.25 + 0.6 * number / vehicles) if number else "#d55e00"
            names = {0: "vehicle that brakes", vehicles // 2: "vehicles behind; lighter: farther"}
            style: dict[str, Any] = {"color": colour, "linewidth": 1.3}
            if number in names:
                style["label"] = names[number]
            axes.plot(response.times_s, response.speed_mps[:, number], **style)
        axes.axvspan(0.0, BRAKING_S, color="#f3e3d6", zorder=0, label="while it brakes")
        axes.set_title(
            f"{shown.formation}: one brakes by {shown.drop_mps:g} m/s, "
            f"{100 * shown.loss:g} % message loss"
        )
        if shown is SHOWN[0]:
            axes.legend(fontsize=8, frameon=False, loc="upper right")
        axes.set_xlabel("time since the disturbance began (s)")
        axes.set_ylabel("speed error (m/s)")
        axes.set_xlim(0.0, SHOWN_S)
    colours = dict(zip(DRAWN_MPS, COLOURS, strict=True))
    for entry in table:
        if entry["formation"] == "column" and entry["drop_mps"] in DRAWN_MPS:
            # The points of a vehicle are displaced, so that none hides another.
            place = DRAWN_MPS.index(entry["drop_mps"]) - 2
            last.plot(
                np.arange(len(entry["speed_mps"])) + 0.12 * place * bool(entry["loss"]),
                entry["speed_mps"],
                color=colours[entry["drop_mps"]],
                marker="o" if entry["loss"] else "",
                linestyle="none" if entry["loss"] else "-",
                markersize=4,
                label="" if entry["loss"] else f"brakes by {entry['drop_mps']:g} m/s",
            )
    last.set_title(f"column: largest speed error of {table[0]['runs']} runs")
    last.set_xlabel("vehicle behind (lines: no message loss; points: 50 %)")
    last.set_ylabel("|speed error| (m/s)")
    last.set_ylim(0.0, 12.0)
    last.legend(fontsize=8, frameon=False, ncols=3, loc="upper right")
    for axes in figure.axes:
        axes.title.set_fontsize(10)
        axes.grid(visible=True, color="#e6e8eb", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    save(figure, FIGURE, 110)


def main() -> int:
    """Simulate, write, print, and return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path, default=OUT, help="output file")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="number of runs of each case")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="number of processes")
    chosen = parser.parse_args()
    quiet = structlog.make_filtering_bound_logger(logging.ERROR)
    seeds = range(1, chosen.seeds + 1)
    todo = [evolve(case, seed=seed) for case in cases() for seed in seeds]
    with ProcessPoolExecutor(
        chosen.jobs, initializer=structlog.configure, initargs=(None, quiet)
    ) as pool:
        found = list(pool.map(respond, todo))
    runs = {
        case: found[first : first + len(seeds)]
        for case, first in zip(cases(), range(0, len(found), len(seeds)), strict=True)
    }
    table = [row(case, responses) for case, responses in runs.items()]
    chosen.json.write_text(json.dumps({"rows": table}, indent=1) + "\n", encoding="utf-8")
    draw(runs, table)
    for entry in table:
        sys.stdout.write(json.dumps(entry) + "\n")
    return int(any(entry["overlaps"] for entry in table))


if __name__ == "__main__":
    sys.exit(main())
