"""The report of a run, or of several runs side by side: pictures and a page.

The report of one run is a comparison with a single run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from attrs import define, field

from laneweave.launch.drawing.colours import has_preferences, sorting_start
from laneweave.launch.drawing.figures import DPI, FigureFormat
from laneweave.launch.drawing.road_scene import describe_closed_parts
from laneweave.launch.recordings.runs import Comparison, Run, single_run
from laneweave.launch.recordings.trajectories import Tracks, read_tracks
from laneweave.launch.report import distributions, figures
from laneweave.launch.report.animation import animation_data
from laneweave.launch.report.page import Animation, Picture, Section, write_page
from laneweave.launch.report.path_maps import DrivenMap, draw_path_map, driven_map
from laneweave.launch.report.snapshots import changes_gradually, road_snapshots
from laneweave.launch.report.tables import tables_of
from laneweave.protocol.errors import CommandFailedError
from laneweave.sim_bridge.recording.trips import WARM_UP_S

REPORT_DPI = 300
PAPER_STRETCH_M = (500.0, 800.0)
"""Stretch of road in the paper's snapshots (Section 5.2.3) [m]."""

COUNTED = (
    f"Counted are vehicles that entered after the first {WARM_UP_S:g} s and not after the last "
    "arrival, and have left; on corridors, all that have left."
)
TOO_SHORT = f"No vehicle was counted, because the runs are too short. {COUNTED}"
SPEED_CLOSED_CAPTION = (
    "Hatched at the left edge, between dotted lines: positions at which a lane is closed."
)
STEADY_CAPTION = (
    f"Samples from {WARM_UP_S:g} s to the end of the demand, or of the whole run if that time is "
    "too short."
)
SPACING_CAPTION = (
    "Spacing: distance between the front bumpers of successive vehicles in a lane, sampled every "
    "second. Time headway: spacing divided by the speed of the following, moving vehicle. "
    "Thin grey dashed lines: pitch d_F of the lattice, and the headway d_F / v_F. " + STEADY_CAPTION
)
COMFORT_CAPTION = (
    "Share of the driving time above each value; values beyond the axes are not shown. Thin grey "
    "dashed lines: limits of the vehicles that laneweave drives; those that SUMO drives have no "
    "limit of jerk. Jerk: difference quotient of the acceleration; lateral acceleration: second "
    "difference quotient of the lateral position, without instantaneous lane changes. "
    + STEADY_CAPTION
)


def travel_caption(*, several: bool) -> str:
    """Return the caption of the travel times of several runs, or of one."""
    return _sentences(
        f"Travel times of the counted vehicles{' of all seeds' * several}, including the wait at "
        f"the entrance. {COUNTED}",
        "Boxes: quartiles and median; whiskers: at most 1.5 interquartile ranges; "
        "small dots: vehicles beyond the whiskers.",
        "Large markers and lines: means. Methods are side by side at each volume. The axis is "
        "broken if only some methods jam."
        if several
        else "Large marker: mean.",
        "Dashed, free flow: time at v_F from the start of the road to its end, without waiting; "
        "vehicles that catch up with a cell ahead take less.",
    )


def flow_caption(*, shares: bool, seeds: bool) -> str:
    """Return the caption of the throughput.

    Args:
        shares: whether the figure also has shares in the preferred lane.
        seeds: whether there are several seeds.
    """
    return _sentences(
        "Throughput: rate at which vehicles pass the end of the road, between the first and the "
        "last counted one, as a share of the demand (dashed: 100 %). Over this short time "
        "arrivals can be denser than on average, and a jam can hold up the first vehicle, so that "
        "the throughput exceeds the demand.",
        "Left in the preferred lane: share of the vehicles that left." if shares else "",
        "Methods are side by side at each volume.",
        "Small dots: runs; markers and bars: means and standard deviations over the seeds."
        if seeds
        else "",
    )


def speed_caption(*, several: bool) -> str:
    """Return the caption of the mean speeds of several runs, or of one."""
    return _sentences(
        "Mean speed in bins of 20 m and 5 s"
        + (", in the first run with trajectories of each method and volume." if several else "."),
        "White: v_F; red: slower; blue: faster; grey: no vehicle. Scale: square root of the "
        "difference from v_F, on each side up to its 98th percentile, rounded up; it differs "
        "between reports. Dashed: the position from which vehicles change lanes.",
    )


@define
class _Report:
    """A report under construction."""

    figures: Path
    """Folder of the pictures."""
    dpi: int
    file_format: FigureFormat
    """Format of the figures beside the PNG files of the page."""
    names: Mapping[str, str] = field(factory=dict)
    """File names of pictures in the report of a single run, by name in a comparison."""
    sections: list[Section] = field(factory=list)

    def draw(
        self, name: str, draw: Callable[[Path, int], None], caption: str, alt: str
    ) -> list[Picture]:
        """Draw a picture and return it in a list."""
        path = self.figures / self.names.get(name, name)
        draw(path, self.dpi)
        if self.file_format is not FigureFormat.PNG:
            draw(path.with_suffix(f".{self.file_format}"), self.dpi)
        return [Picture(path, self.dpi, caption, alt)]

    def add(
        self, title: str, name: str, draw: Callable[[Path, int], None], caption: str, alt: str
    ) -> None:
        """Add a section with one picture."""
        self.sections.append(Section(title, pictures=self.draw(name, draw, caption, alt)))


def draw_report(folder: Path) -> Path:
    """Write the pictures and the page of a finished run; return the path of the page.

    Raises:
        CommandFailedError: the files cannot be written.
    """
    try:
        return report_run(single_run(folder))
    except OSError as error:
        raise CommandFailedError(f"{folder}: the report cannot be written: {error}") from error


def report_run(
    run: Run,
    *,
    formation: int | None = None,
    dpi: int = DPI,
    file_format: FigureFormat = FigureFormat.PNG,
) -> Path:
    """Write pictures and page of a run to its folder; return the path of the page.

    For arguments and errors see `report_comparison`.
    """
    road, title = run.scenario.road, f"laneweave run: {run.folder.resolve().name}"
    lead = _sentences(
        f"{run.title}.",
        f"{road.lanes} lanes, {road.length_m:g} m; {sorting_start(run.scenario)} at "
        f"{run.scenario.geometry.moves_from_m:g} m.",
        describe_closed_parts(run.scenario),
        "" if run.scenario.flow.lane_shares else "Vehicles have no preferred lanes.",
        f"Vehicles arrive for {run.scenario.demand.duration_s:g} s.",
    )
    names = {"travel_times.png": "travel_time.png", "speeds.png": "speed.png"}
    names[f"road-{run.label}.png"] = "road.png"
    report = _Report(run.folder, dpi, file_format, names)
    sections = _sections(Comparison((run,), ()), report, formation)
    return write_page(title, lead, sections, run.folder)


def report_comparison(
    comparison: Comparison,
    out: Path,
    title: str,
    *,
    formation: int | None = None,
    file_format: FigureFormat = FigureFormat.PNG,
) -> Path:
    """Write pictures and page of several runs; return the path of the page.

    Args:
        comparison: the runs, of which at least one succeeded.
        out: folder of the page and of the folder `figures`.
        title: title of the page.
        formation: formation whose path map is drawn; None: the one with the most moves.
        file_format: format of the figures; SVG and PDF are written beside the PNG files.

    Raises:
        BadInputError: the run has no such formation, or a file of a run cannot be read.
        OSError: a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    runs = len(comparison.runs)
    roads = {describe_closed_parts(run.scenario) for run in comparison.runs}
    lead = _sentences(
        f"{runs} runs of {', '.join(comparison.labels)}; {len(comparison.failed)} failed.",
        roads.pop() if len(roads) == 1 else "The runs differ in the closed parts of lanes.",
    )
    sections = _sections(comparison, _Report(out / "figures", REPORT_DPI, file_format), formation)
    return write_page(title, lead, sections, out)


def _sections(comparison: Comparison, report: _Report, formation: int | None) -> list[Section]:
    """Return all sections."""
    several = not report.names
    busiest = [run for run in map(comparison.busiest, comparison.labels) if run is not None]
    shown = [(run, read_tracks(run.folder)) for run in busiest]
    # Do this first, because it raises an error for an unknown formation.
    example = next((one for one in shown if not several or _has_formations(one[0])), None)
    driven = driven_map(*example, formation) if example else None
    if shown:
        animations = [Animation(animation_data(run, tracks)) for run, tracks in shown]
        report.sections.append(Section("The moving road", animations=animations))
    report.sections.append(Section("Results", tables=tables_of(comparison)))
    summaries = [run.summary for run in comparison.runs if run.summary is not None]
    if any(one.travel_time_s.mean is not None for one in summaries):
        _add_results(report, comparison, several=several)
    else:
        report.sections.append(Section("Travel time", note=TOO_SHORT))
    if busiest:
        closed = any(run.scenario.road.closures for run in busiest)
        report.add(
            "Speed over space and time",
            "speeds.png",
            partial(figures.draw_speeds, comparison),
            _sentences(speed_caption(several=several), SPEED_CLOSED_CAPTION * closed),
            "Heat maps of mean speed over time and position, one for each method and volume",
        )
        pictures = [one for run, tracks in shown for one in _snapshots(report, run, tracks)]
        report.sections.append(Section("Snapshots", pictures=pictures))
        if example and driven:
            _add_path_map(report, driven, example[0].title)
        _add_distributions(report, comparison)
    return report.sections


def _add_results(report: _Report, comparison: Comparison, *, several: bool) -> None:
    """Add travel times and, of several runs, throughput."""
    report.add(
        "Travel time",
        "travel_times.png",
        partial(figures.draw_travel_times, comparison),
        travel_caption(several=several),
        "Box plots of travel times by method and traffic volume",
    )
    if several:
        shares = figures.shares_differ(comparison)
        report.add(
            "Throughput and lanes" if shares else "Throughput",
            "flows.png",
            partial(figures.draw_flows, comparison),
            flow_caption(
                shares=shares, seeds=len({run.scenario.seed for run in comparison.runs}) > 1
            ),
            f"Throughput{' and share in the preferred lane' * shares} against traffic volume",
        )


def _snapshots(report: _Report, run: Run, tracks: Tracks) -> list[Picture]:
    # A comparison shows the paper's stretch for all methods, if the road is long enough.
    fits = not report.names and run.scenario.road.length_m >= PAPER_STRETCH_M[1]
    stretch_m = PAPER_STRETCH_M if fits and not run.scenario.road.closures else None
    preferences = has_preferences(run.scenario)
    times = (
        "at which the most vehicles change lanes."
        if changes_gradually(tracks, run.scenario)
        else "at which the most vehicles are on this stretch; "
        "lane changes of this method are instantaneous."
    )
    if preferences:
        exits = " and exits" * bool(run.scenario.exit)
        colours = f"Colours and numbers on vehicles show the preferred lanes (0: rightmost){exits}"
        colours += "; faster vehicles are lighter."
    else:
        colours = (
            "Colours show the lane in which a vehicle arrived (0: rightmost); faster vehicles "
        )
        colours += "are lighter; a pale stripe is at the front."
    caption = _sentences(
        f"{run.title}. The four times, {run.scenario.timing.cycles_s[0]:g} s apart, {times}",
        colours,
        "Hatched: closed; thick line: stop line before it." if run.scenario.road.closures else "",
    )
    coloured = f" coloured by {'preferred lane' if preferences else 'lane of arrival'}"
    return report.draw(
        f"road-{run.label}.png",
        lambda path, dpi: road_snapshots(run.folder, path, stretch_m=stretch_m, dpi=dpi),
        caption,
        f"Four strips of road with vehicles{coloured}, {run.label}",
    )


def _add_path_map(report: _Report, driven: DrivenMap, title: str) -> None:
    report.add(
        "Relative path map",
        "path_map.png",
        partial(draw_path_map, driven),
        f"{title}. Cells (column, lane) of {driven.vehicles} at the ends of slots, as driven; "
        "columns are counted from the rearmost. "
        f"{driven.colours}; bold: moved in the preceding slot. Cost: the sum over the vehicles of "
        "the slot from whose end on they stay in their last cell.",
        f"Table of the cells of {driven.name} by vehicle and slot",
    )


def _add_distributions(report: _Report, comparison: Comparison) -> None:
    """Add the distributions over all runs with trajectories; read one run at a time."""
    counted: dict[tuple[str, float], distributions.Counts] = {}
    scenarios = [run.scenario for run in comparison.runs if run.has_trajectories]
    for run in comparison.runs:
        if run.has_trajectories:
            key = (run.label, run.volume_veh_per_lane_h)
            more = distributions.count(read_tracks(run.folder), run.scenario)
            counted[key] = counted.get(key, distributions.Counts()) + more
    report.add(
        "Spacings and time headways",
        "spacing.png",
        partial(distributions.draw_spacings, counted, scenarios),
        SPACING_CAPTION,
        "Cumulative distributions of spacing and time headway",
    )
    report.add(
        "Deceleration and comfort",
        "comfort.png",
        partial(distributions.draw_comfort, counted, scenarios),
        COMFORT_CAPTION,
        "Shares of driving time above each deceleration, jerk and lateral acceleration",
    )


def _has_formations(run: Run) -> bool:
    return run.summary is not None and run.summary.planning.largest_formation > 0


def _sentences(*parts: str) -> str:
    """Join the sentences that are not empty."""
    return " ".join(part for part in parts if part)
