"""Reports: of one run, or of many side by side."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from attrs import define, field

from laneweave.launch.drawing.figures import DPI
from laneweave.launch.report import comparison_figures, distribution_figures, tables
from laneweave.launch.report.animation import animation_data
from laneweave.launch.report.distributions import Counts, count
from laneweave.launch.report.figures import speed_heatmap, travel_time_boxplot
from laneweave.launch.report.page import Page, Section, picture, player, write_page
from laneweave.launch.report.path_maps import DrivenMap, draw_path_map, driven_map
from laneweave.launch.report.runs import Comparison, Run
from laneweave.launch.report.snapshots import road_snapshots
from laneweave.launch.report.trajectories import Tracks, read_tracks

REPORT_DPI = 300
PAPER_STRETCH_M = (500.0, 800.0)
"""Where the paper's snapshots are taken (Section 5.2.3)."""

SPACING_CAPTION = (
    "Spacing: front bumper to front bumper of the next vehicle ahead on the lane, looked at every "
    "second. Time headway: spacing over the speed of the one behind, where it moves. Dashed: the "
    "pitch d_F of the lattice, and the time that it takes at v_F. Counted from 60 s to the end of "
    "the demand, the whole run where that is too short."
)
COMFORT_CAPTION = (
    "Share of the driving time with more than that. Dashed: the limits of the vehicles. Jerk is "
    "the change of acceleration from tick to tick; lateral acceleration the second difference of "
    "the place across the road. Counted at the same times as spacings."
)


@define
class _Report:
    """A report that is being made."""

    folder: Path
    """Where the page goes."""
    figures: Path
    """Where the pictures go."""
    dpi: int
    sections: list[Section] = field(factory=list)
    animations: list[dict[str, object]] = field(factory=list)

    def add_picture(
        self, title: str, name: str, draw: Callable[[Path], None], caption: str, alt: str
    ) -> None:
        """Draw a picture, and add a section with it."""
        path = self.figures / name
        draw(path)
        self.sections.append(Section(title, picture(path, self.dpi, caption, alt)))

    def add_players(self, shown: list[tuple[Run, Tracks, str]]) -> None:
        """Add a section with animations."""
        bodies = []
        for run, tracks, title in shown:
            data = animation_data(run, tracks, title)
            bodies.append(player(len(self.animations), data))
            self.animations.append(data)
        self.sections.append(Section("The moving road", "\n".join(bodies)))

    def write(self, title: str, lead: str) -> Path:
        """Write the page."""
        return write_page(Page(title, lead, self.sections, self.animations), self.folder)


def report_run(run: Run, *, formation: int | None = None, dpi: int = DPI) -> Path:
    """Write the pictures and the page of one run into its folder; return the page.

    Args:
        run: the run.
        formation: whose path map is drawn; None: the one that moves most.
        dpi: resolution of the pictures in dots per inch.

    Raises:
        BadInputError: the run has no such formation.
        OSError: a file cannot be read or written.
        ValueError, KeyError: it is not the folder of a finished run.
    """
    folder, tracks = run.folder, read_tracks(run.folder)
    driven = driven_map(run, tracks, formation)
    report = _Report(folder, folder, dpi)
    report.sections.append(Section("Summary", tables.run_table(run)))
    report.add_players([(run, tracks, _title(run))])
    report.add_picture(
        "Snapshots",
        "road.png",
        lambda out: road_snapshots(folder, out, dpi=dpi),
        "The same stretch of road at four instants, the shortest T_F apart. Colours are the lanes "
        "that vehicles prefer; the faster, the lighter.",
        "Four strips of road with vehicles coloured by preferred lane",
    )
    report.add_picture(
        "Speed over space and time",
        "speed.png",
        lambda out: speed_heatmap(folder, out, dpi=dpi),
        "Mean speed in bins of 20 m and 5 s; grey: nobody was there.",
        "Heat map of mean speed over time and position",
    )
    report.add_picture(
        "Travel time",
        "travel_time.png",
        lambda out: travel_time_boxplot([folder], out, dpi=dpi),
        "Travel times of the counted vehicles, waiting to enter included.",
        "Box plot of travel times",
    )
    _add_path_map(report, driven)
    counted = {(run.label, run.volume_veh_per_lane_h): count(tracks, run.scenario)}
    _add_distributions(report, counted, run)
    return report.write(f"laneweave run: {folder.resolve().name}", _lead(run))


def report_comparison(
    comparison: Comparison, out: Path, title: str, *, formation: int | None = None
) -> Path:
    """Write the pictures and the page of many runs; return the page.

    Args:
        comparison: the runs; at least one that did not fail.
        out: folder of the page; the pictures go to `figures` in it.
        title: what is compared.
        formation: whose path map is drawn; None: the one that moves most.

    Raises:
        BadInputError: the run that is shown has no such formation.
        OSError: a file cannot be read or written.
        ValueError, KeyError: a folder is not that of a finished run.
    """
    out.mkdir(parents=True, exist_ok=True)
    report = _Report(out, out / "figures", REPORT_DPI)
    busiest = [run for run in map(comparison.busiest, comparison.labels) if run is not None]
    shown = [(run, read_tracks(run.folder), _title(run)) for run in busiest]
    # First of all: what may be refused.
    maps = (driven_map(run, tracks, formation) for run, tracks, _ in shown if _has_formations(run))
    driven = next(maps, None)
    numbers = (
        tables.traffic_table,
        tables.safety_table,
        tables.planning_table,
        tables.failed_table,
    )
    body = "\n".join(make(comparison) for make in numbers)
    report.sections.append(Section("Numbers", body))
    report.add_picture(
        "Travel time",
        "travel_times.png",
        lambda path: comparison_figures.draw_travel_times(comparison, path, REPORT_DPI),
        "Travel times of the counted vehicles of all seeds: boxes from the lower to the upper "
        "quartile with the median, whiskers up to 1.5 times as far; dots and lines are means. "
        "Where a method jams, the axis is broken.",
        "Box plots of travel times by method and traffic volume",
    )
    report.add_picture(
        "Throughput and lanes",
        "flows.png",
        lambda path: comparison_figures.draw_flows(comparison, path, REPORT_DPI),
        "Left: rate at which vehicles pass the end of the road, between the first and the last "
        "counted one. Right: share of those who left on the lane that they prefer. Small dots are "
        "runs; bars are standard deviations over seeds.",
        "Throughput and share on the preferred lane against traffic volume",
    )
    if busiest:
        _add_shown(report, comparison, shown)
        _add_path_map(report, driven)
        _add_distributions(report, _counted(comparison), busiest[0])
        report.add_players(shown)
    runs = len(comparison.runs)
    lead = f"{runs} runs of {', '.join(comparison.labels)}; {len(comparison.failed)} failed."
    return report.write(title, lead)


def _add_shown(
    report: _Report, comparison: Comparison, shown: list[tuple[Run, Tracks, str]]
) -> None:
    """Add what needs trajectories: heat maps of all, snapshots of the highest volume."""
    report.add_picture(
        "Speed over space and time",
        "speeds.png",
        lambda path: comparison_figures.draw_speeds(comparison, path, REPORT_DPI),
        "Mean speed in bins of 20 m and 5 s, the first run with trajectories of each; one scale "
        "for all. Grey: nobody was there. Dashed: lane sorting begins.",
        "Heat maps of mean speed over time and position, one for each method and volume",
    )
    bodies = []
    for run, _, title in shown:
        path = report.figures / f"road-{run.label}.png"
        length_m = run.scenario.road.length_m
        stretch_m = PAPER_STRETCH_M if length_m >= PAPER_STRETCH_M[1] else None
        road_snapshots(run.folder, path, stretch_m=stretch_m, dpi=report.dpi)
        caption = f"{title}. Four instants, the shortest T_F apart; colours are preferred lanes."
        alt = f"Four strips of road with vehicles coloured by preferred lane, {run.label}"
        bodies.append(picture(path, report.dpi, caption, alt))
    report.sections.append(Section("Snapshots", "\n".join(bodies)))


def _add_path_map(report: _Report, driven: DrivenMap | None) -> None:
    if driven is None:
        return
    report.add_picture(
        "Relative path map",
        "path_map.png",
        lambda path: draw_path_map(driven, path, report.dpi),
        f"The cells (column, lane) of {driven.whose} at the ends of slots, as driven. "
        "The box before a name has the colour of the preferred lane; cells have the colour of "
        "their lane, strong where that is the preferred one; bold: moved in the slot before.",
        f"Table of the cells of {driven.name} by vehicle and slot",
    )


def _add_distributions(
    report: _Report, counted: dict[tuple[str, float], Counts], example: Run
) -> None:
    report.add_picture(
        "Spacing and headway",
        "spacing.png",
        lambda path: distribution_figures.draw_spacings(
            counted, example.scenario, path, report.dpi
        ),
        SPACING_CAPTION,
        "Cumulative distributions of spacing and time headway",
    )
    report.add_picture(
        "Deceleration and comfort",
        "comfort.png",
        lambda path: distribution_figures.draw_comfort(counted, example.scenario, path, report.dpi),
        COMFORT_CAPTION,
        "Shares of driving time above each deceleration, jerk and lateral acceleration",
    )


def _counted(comparison: Comparison) -> dict[tuple[str, float], Counts]:
    """Count over all runs that have trajectories, one at a time in memory."""
    counted: dict[tuple[str, float], Counts] = {}
    for run in comparison.runs:
        if run.has_trajectories:
            key = (run.label, run.volume_veh_per_lane_h)
            more = count(read_tracks(run.folder), run.scenario)
            counted[key] = counted.get(key, Counts()) + more
    return counted


def _has_formations(run: Run) -> bool:
    return bool(run.summary.get("planning", {}).get("largest_formation"))


def _title(run: Run) -> str:
    return f"{run.label}, {run.volume_veh_per_lane_h:g} veh/(lane·h), seed {run.scenario.seed}"


def _lead(run: Run) -> str:
    road = run.scenario.road
    return (
        f"{_title(run)}. {road.lanes} lanes, {road.length_m:g} m; lane sorting begins at "
        f"{road.sorting_start_m:g} m. Vehicles arrive for {run.scenario.demand.duration_s:g} s."
    )
