"""The figures of docs/EVALUATION_PAPERS_ROAD.md, from the runs of a sweep."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Final

from attrs import frozen

from evaluation.evidence import Picture
from evaluation.points import SeedKey
from evaluation.programme import LABELS, VOLUMES
from evaluation.statements import PAPER_STRETCH_M, PAPER_VOLUMES
from laneweave.launch.recordings.runs import Comparison, Run
from laneweave.launch.recordings.trajectories import read_tracks
from laneweave.launch.report.distributions import Counts, count, draw_spacings
from laneweave.launch.report.figures import draw_flows, draw_speeds, draw_travel_times
from laneweave.launch.report.snapshots import road_snapshots

DPI: Final = 110
SHOWN_VOLUME: Final = 1600.0
"""The highest volume of the paper, in vehicles/(lane h)."""


@frozen
class _Figure:
    """A figure, and the labels and volumes of its runs."""

    picture: Picture
    labels: tuple[str, ...]
    volumes: tuple[float, ...]
    draw: Callable[[Comparison, Path, int], None]
    traced: bool = False
    """Whether the runs need trajectories."""

    def shows(self, label: str, volume_veh_per_lane_h: float) -> bool:
        """Return whether runs with this label and volume are in the figure."""
        return label in self.labels and volume_veh_per_lane_h in self.volumes


def draw_pictures(
    runs: Sequence[Run], folder: Path, needed: Collection[SeedKey] = ()
) -> tuple[Picture, ...]:
    """Draw figures, and return those drawn.

    Args:
        runs: runs of the sweep; failed ones are excluded.
        folder: folder of the figures.
        needed: runs that a figure must not lose. It is not drawn without one of those that it
            shows; if it needs trajectories, without a run of the same label and volume.
    """
    drawn = []
    for figure in _FIGURES:
        chosen = Comparison.of(
            run
            for run in runs
            if figure.shows(run.label, run.volume_veh_per_lane_h)
            and (run.has_trajectories or not figure.traced)
        )
        found = [_seed_key(run) for run in (*chosen.runs, *chosen.failed)]
        # Few runs keep their trajectories.
        parts = 2 if figure.traced else 3
        have = {key[:parts] for key in found}
        missing = (key for key in needed if figure.shows(*key[:2]) and key[:parts] not in have)
        if chosen.runs and not any(missing):
            figure.draw(chosen, folder / figure.picture.name, DPI)
            drawn.append(figure.picture)
    return tuple(drawn)


def _seed_key(run: Run) -> SeedKey:
    return run.label, run.volume_veh_per_lane_h, run.scenario.seed


def _draw_snapshots(comparison: Comparison, out: Path, dpi: int) -> None:
    road_snapshots(comparison.runs[0].folder, out, stretch_m=PAPER_STRETCH_M, dpi=dpi)


def _draw_spacings(comparison: Comparison, out: Path, dpi: int) -> None:
    counted: dict[tuple[str, float], Counts] = {}
    for label in comparison.labels:
        run = comparison.representative(label, SHOWN_VOLUME)
        if run is not None:
            counted[label, SHOWN_VOLUME] = count(read_tracks(run.folder), run.scenario)
    draw_spacings(counted, [run.scenario for run in comparison.runs], out, dpi)


def _snapshots(label: str, description: str) -> _Figure:
    picture = Picture(
        f"evaluation-road-{label}.png",
        f"Four strips of road from 500 to 800 m, {label}",
        f"The road from 500 to 800 m at 1600 veh/(lane h), {description}: four instants, 4 s "
        "apart. Colours and numbers on vehicles show preferred lanes; faster vehicles are lighter.",
    )
    return _Figure(picture, (label,), (SHOWN_VOLUME,), _draw_snapshots, traced=True)


_FIGURES: Final = (
    _Figure(
        Picture(
            "evaluation-paper.png",
            "Box plots of travel times at the paper's volumes",
            "Travel times at the paper's volumes: formations of at most six vehicles, with the "
            "default and with the paper's settings, and two interpretations of the paper's rules. "
            "Boxes: quartiles over the vehicles of the successful runs; whiskers: at most "
            "1.5 interquartile ranges; small dots: vehicles beyond them; large markers and lines: "
            "means. The axis is broken where a method congests.",
        ),
        ("formations", "paper-6", "rule", "rule-net"),
        PAPER_VOLUMES,
        draw_travel_times,
    ),
    _Figure(
        Picture(
            "evaluation-all.png",
            "Box plots of travel times at all volumes",
            "Travel times of four methods, each up to its highest volume: both operations, the "
            "paper's rules in the interpretation that carries most, and SUMO's best-tuned drivers. "
            "Volumes have places of equal width.",
        ),
        ("formations", "rolling", "rule-yielding", "lc2013-tuned"),
        VOLUMES,
        draw_travel_times,
    ),
    _Figure(
        Picture(
            "evaluation-flows.png",
            "Throughput and share in the preferred lane against the demand",
            "Throughput between the first and the last counted vehicle, as a share of the demand, "
            "and share in the preferred lane. Methods are side by side at each volume. Small "
            "dots: runs; markers and bars: means and standard deviations over the seeds.",
        ),
        LABELS,
        VOLUMES,
        draw_flows,
    ),
    _Figure(
        Picture(
            "evaluation-speeds.png",
            "Heat maps of mean speed over time and position",
            "Mean speed in bins of 20 m and 5 s, in one run each. White: v_F; red: slower; blue: "
            "faster; grey: no vehicle; on each side a square root of the difference. Dashed: start "
            "of lane sorting.",
        ),
        ("formations", "paper-6", "rule", "rule-net"),
        PAPER_VOLUMES[1:],
        draw_speeds,
        traced=True,
    ),
    _snapshots("formations", "formations of at most six"),
    _snapshots("paper-6", "the paper's formations of at most six"),
    _snapshots("rule", "the rules, d_R front to front, with instantaneous lane changes"),
    _snapshots("rule-net", "the rules, d_R as a net gap, with instantaneous lane changes"),
    _Figure(
        Picture(
            "evaluation-spacing.png",
            "Distributions of spacing and time headway at 1600",
            "Spacing and time headway at 1600 veh/(lane h), front bumper to front bumper, one run "
            "each. "
            "Thin grey dashed lines: d_F, and the time that it takes at v_F.",
        ),
        ("formations", "rolling", "rule", "lc2013"),
        (SHOWN_VOLUME,),
        _draw_spacings,
        traced=True,
    ),
)
