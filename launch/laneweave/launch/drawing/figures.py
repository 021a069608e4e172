"""What all pictures share: the scenario in a run's files, figures, and how they are saved.

matplotlib is imported when the first picture is drawn, so that the command line starts fast.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow.parquet as pq

from laneweave.protocol.config.loading import parse_scenario
from laneweave.protocol.scenario.tables import Scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 150
INK, FAINT_INK = "#30343a", "#6a7078"
SCENARIO_KEY = b"laneweave.scenario"


def scenario_of(path: Path) -> Scenario:
    """Return the scenario that a run's file carries, the default one if it carries none."""
    metadata = pq.read_schema(path).metadata or {}
    text = metadata.get(SCENARIO_KEY)
    data: dict[str, Any] = json.loads(text) if text else {}
    return parse_scenario(data)


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - lazily
    from matplotlib.figure import Figure  # noqa: PLC0415 - lazily

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, out: Path, dpi: float) -> None:
    """Write a picture."""
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=dpi)
