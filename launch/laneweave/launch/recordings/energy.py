"""Energy and emissions of a run, by SUMO's emission models on its speeds and accelerations.

The models are those of HBEFA 4 (Handbook Emission Factors for Road Transport) in SUMO. Its program
`emissionsDrivingCycle` evaluates them for each row of the trajectories, as if all vehicles were of
one type; slopes are zero.
"""

from __future__ import annotations

import math
import os
import subprocess
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq

from laneweave.launch.recordings.files import TRAJECTORIES_FILE, reading
from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.protocol.summary import EnergyFigures
from laneweave.sim_bridge.sumo.simulation import sumo_program

MODELS: Final[Mapping[str, str]] = {
    "petrol": "HBEFA4/PC_petrol_Euro-6d",
    "diesel": "HBEFA4/PC_diesel_Euro-6d",
    "electric": "HBEFA4/PC_BEV",
}
"""SUMO's emission class of each type of car."""
ROWS_AT_ONCE: Final = 500_000
_CYCLE: Final = pc.WriteOptions(include_header=False, delimiter=";", quoting_style="none")
_SUMS: Final = "sums"
"""Line of the program's output before the sums."""
TIMEOUT_S: Final = 300.0
"""Longest time for `ROWS_AT_ONCE` rows, which take a second."""


def energy_of(folder: Path, models: Mapping[str, str] = MODELS) -> dict[str, EnergyFigures] | None:
    """Return energy and emissions of a run for each type of car.

    None: the package eclipse-sumo is not installed, or no movement was recorded.

    Args:
        folder: the run's folder.
        models: SUMO's emission class of each type.

    Raises:
        BadInputError: the trajectories cannot be read.
        CommandFailedError: a model does not exist, or its results are not finite.
        OSError: there is no room for temporary files, or the program cannot be started.
    """
    program = sumo_program("emissionsDrivingCycle")
    if program is None or not program.is_file() or not (folder / TRAJECTORIES_FILE).is_file():
        return None
    totals = {model: Counter[str]() for model in models.values()}
    speeds = 0.0
    with temporary_folder("energy") as temporary:
        cycle = temporary / "cycle.csv"
        for speed_mps, accel_mps2 in _speeds(folder):
            speeds += float(speed_mps.sum())
            rows = np.arange(len(speed_mps), dtype=np.float64)
            columns = [rows, speed_mps, accel_mps2, np.zeros(len(rows))]
            pc.write_csv(pa.table(columns, names=[*"tvas"]), cycle, _CYCLE)
            for model, total in totals.items():
                total.update(_sums(program, cycle, model))
    if not speeds:
        return None
    per_km = 1000.0 / speeds  # rows are equally far apart in time
    return {
        name: EnergyFigures(
            model=model,
            co2_g_per_km=round(per_km * totals[model]["CO2"] / 1000.0, 3),
            nox_mg_per_km=round(per_km * totals[model]["NOx"], 3),
            fuel_g_per_km=round(per_km * totals[model]["fuel"] / 1000.0, 3),
            electricity_wh_per_km=round(per_km * totals[model]["electricity"], 3),
        )
        for name, model in models.items()
    }


def _speeds(folder: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield speeds [m/s] and accelerations [m/s2] of a run in parts."""
    with reading(folder, TRAJECTORIES_FILE), pq.ParquetFile(folder / TRAJECTORIES_FILE) as file:
        names = ["speed_mps", "accel_mps2"]
        for batch in file.iter_batches(ROWS_AT_ONCE, columns=names):
            speed_mps, accel_mps2 = (column.to_numpy() for column in batch.columns)
            yield speed_mps.astype(np.float64), accel_mps2.astype(np.float64)


def _sums(program: Path, cycle: Path, model: str) -> dict[str, float]:
    """Return the sums of a model's results over all rows of a driving cycle, in mg/s and Wh/s.

    Raises:
        CommandFailedError: the model does not exist, or its results are not finite.
        OSError: the program cannot be started.
    """
    command = [str(program), "--timeline-file", str(cycle), "--emission-class", model]
    # One column of output takes half the time of all.
    command += ["--output", os.devnull, "--output.attributes", "fuel"]
    try:
        done = subprocess.run(  # noqa: S603
            command, capture_output=True, text=True, check=False, timeout=TIMEOUT_S
        )
    except subprocess.TimeoutExpired as error:
        text = f"emission model {model}: no result after {TIMEOUT_S:g} s"
        raise CommandFailedError(text) from error
    if done.returncode:
        raise CommandFailedError(f"emission model {model}: {' '.join(done.stderr.split())}")
    lines = done.stdout.partition(_SUMS)[2].split()
    sums = {
        name: float(value)
        for name, colon, value in (line.partition(":") for line in lines)
        if colon
    }
    wrong = [name for name, value in sums.items() if not math.isfinite(value)]
    if wrong or not sums:
        what = ", ".join(wrong) or "the result"
        raise CommandFailedError(f"emission model {model}: {what} is not finite")
    return sums
