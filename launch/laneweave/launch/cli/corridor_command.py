"""`laneweave corridor`: what can be a corridor in a SUMO simulation, and its scenario file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from laneweave.protocol.errors import BadInputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from laneweave.sim_bridge.corridors.corridor_search import Approach, Candidate
    from laneweave.sim_bridge.corridors.sumo_corridor import SumoCorridor
    from laneweave.sim_bridge.corridors.sumo_simulation import TimeWindow

TURNS = "lanes to edge: veh/h"
"""Title of a column: the lanes that lead to each edge behind an approach, and their volume."""
MAX_BEGIN_S = 1e9
MAX_SCALE = 1e3
CORRIDOR_HELP = "The corridor's first and last edge."
Begin = Annotated[
    float | None,
    typer.Option("--begin", help="SUMO's time of the first departure [s].", show_default=False),
]
End = Annotated[
    float | None,
    typer.Option("--end", help="SUMO's time of the last departure [s].", show_default=False),
]
Scale = Annotated[
    float | None, typer.Option("--scale", help="Factor for SUMO's demand.", show_default=False)
]


def corridor(
    sumocfg: Annotated[Path, typer.Argument(metavar="SUMOCFG", help="SUMO's configuration file.")],
    name: Annotated[
        str | None,
        typer.Option("--corridor", metavar="FIRST_EDGE:LAST_EDGE", help=CORRIDOR_HELP),
    ] = None,
    toml: Annotated[
        bool, typer.Option("--toml", help="Print the scenario file of the corridor.")
    ] = False,
    begin: Begin = None,
    end: End = None,
    scale: Scale = None,
) -> None:
    """List what can be a corridor in a SUMO simulation, or describe one."""
    if toml and name is None:
        raise BadInputError("--corridor", "none", "FIRST_EDGE:LAST_EDGE with --toml")
    from laneweave.sim_bridge.corridors.sumo_corridor import read_corridor

    window = time_window(begin, end, scale)
    if name is None:
        _list(sumocfg, window)
        return
    found = read_corridor(sumocfg, name, window)
    if toml:
        import tomli_w

        typer.echo(tomli_w.dumps(corridor_tables(found, sumocfg, window)), nl=False)
        return
    _describe(found, sumocfg, window)


def time_window(
    begin_s: float | None, end_s: float | None, scale: float | None, duration_s: float | None = None
) -> TimeWindow:
    """Return the time window that options describe.

    Raises:
        BadInputError: it is empty, or a number is negative.
    """
    from laneweave.sim_bridge.corridors.sumo_simulation import MAX_DEMAND_S, TimeWindow

    if begin_s is not None and not 0.0 <= begin_s <= MAX_BEGIN_S:
        raise BadInputError("--begin", begin_s, f"0 to {MAX_BEGIN_S:g}")
    if end_s is not None and not end_s > (begin_s or 0.0):
        raise BadInputError("--end", end_s, f"more than {begin_s or 0.0:g}, the begin")
    if scale is not None and not 0.0 < scale <= MAX_SCALE:
        raise BadInputError("--scale", scale, f"more than 0, at most {MAX_SCALE:g}")
    return TimeWindow(
        begin_s=begin_s,
        duration_s=MAX_DEMAND_S if duration_s is None else duration_s,
        end_s=math.inf if end_s is None else end_s,
        scale=scale,
    )


def corridor_tables(found: SumoCorridor, sumocfg: Path, window: TimeWindow) -> dict[str, Any]:
    """Return the tables of the scenario of a corridor.

    Raises:
        BadInputError: laneweave cannot drive it.
    """
    from laneweave.sim_bridge.corridors.scenario_tables import checked_tables

    sumo = {"config": str(sumocfg.resolve()), "corridor": found.corridor.name}
    options = {"begin_s": window.begin_s, "scale": window.scale}
    given = {name: value for name, value in options.items() if value is not None}
    return checked_tables(found, sumo | given)


def _list(sumocfg: Path, window: TimeWindow) -> None:
    from laneweave.sim_bridge.corridors.corridor_search import (
        MIN_APPROACH_M,
        MIN_LANES,
        MIN_LENGTH_M,
        MIN_SPEED_MPS,
        find_approaches,
        find_corridors,
    )
    from laneweave.sim_bridge.corridors.sumo_simulation import read_simulation

    simulation = read_simulation(sumocfg, window)
    approaches = find_approaches(simulation)
    known = {one.name for one in approaches}
    found = [one for one in find_corridors(simulation) if one.name not in known]
    if not found and not approaches:
        raise BadInputError(
            "SUMOCFG",
            str(sumocfg),
            f"a network with a chain of edges of at least {MIN_LENGTH_M:g} m, with at least "
            f"{MIN_LANES} lanes for cars and a speed limit of at least {MIN_SPEED_MPS:g} m/s, "
            f"whose vehicles have priority, or of {MIN_APPROACH_M:g} m before an intersection; "
            "--corridor names shorter or slower ones",
        )
    console = Console()
    if found:
        rows = {one.name: _numbers(one) for one in found}
        title = f"corridors of {escape(sumocfg.name)}"
        columns = "edges", "lanes", "m", "m/s", "ramps", "exits", "veh/h"
        console.print(_table(title, columns, rows))
    if approaches:
        rows = {one.name: _approach_numbers(one) for one in approaches}
        approach_columns = ("lanes", "m", "control", TURNS, "worth it")
        title = f"approaches of intersections in {escape(sumocfg.name)}"
        console.print(_table(title, approach_columns, rows))
    remarks = {one.name: one.problem for one in found}
    corridors = [one.found for one in found if one.found is not None]
    for each in (*corridors, *(one.found for one in approaches)):
        remarks[each.corridor.name] = _remark(each, sumocfg, window)
    for name, remark in remarks.items():
        if remark:
            console.print(f"{escape(name)}: {escape(remark)}", soft_wrap=True)


def _table(title: str, columns: Sequence[str], rows: Mapping[str, Sequence[str]]) -> Table:
    """Return a table of corridors; their names are to be copied, however narrow a terminal is."""
    table = Table(title=title)
    table.add_column("--corridor", min_width=max(map(len, rows)))
    for column in columns:
        text = column in ("control", TURNS, "worth it")
        table.add_column(column, justify="left" if text else "right", no_wrap=text)
    for name, cells in rows.items():
        table.add_row(escape(name), *map(escape, cells))
    return table


def _approach_numbers(one: Approach) -> Sequence[str]:
    corridor = one.found.corridor
    turns = [
        f"{' '.join(map(str, turn.lanes))} to {turn.edge}: {turn.volume_veh_per_h:.0f}"
        for turn in one.turns
    ]
    return (
        f"{corridor.lanes}",
        f"{corridor.length_m:.0f}",
        one.control,
        "\n".join(turns),
        f"{'yes' if one.is_worth_it else 'hardly'}, {one.used_share:.0%}",
    )


def _numbers(one: Candidate) -> Sequence[str]:
    if one.found is None:
        return ("",) * 7
    corridor = one.found.corridor
    return (
        f"{len(corridor.edges)}",
        f"{corridor.lanes}",
        f"{corridor.length_m:.0f}",
        f"{corridor.speed_mps:.1f}",
        f"{len(corridor.ramps)}",
        f"{len(corridor.ways_out)}",
        f"{one.volume_veh_per_h:.0f}",
    )


def _remark(found: SumoCorridor, sumocfg: Path, window: TimeWindow) -> str:
    """Return why laneweave cannot drive a corridor, or what it does not use."""
    try:
        corridor_tables(found, sumocfg, window)
    except BadInputError as error:
        return str(error)
    unused = len(found.corridor.unused)
    return f"{unused} ways not used" if unused else ""


def _describe(found: SumoCorridor, sumocfg: Path, window: TimeWindow) -> None:
    """Print what a corridor consists of."""
    from laneweave.sim_bridge.corridors.scenario_tables import remarks

    corridor, simulation = found.corridor, found.simulation
    console = Console(soft_wrap=True)
    table = Table(
        title=f"corridor {escape(corridor.name)}: {corridor.lanes} lanes, {corridor.length_m:.0f} m"
    )
    for column in ("edge", "from m", "to m", "lanes"):
        table.add_column(column, justify="left" if column == "edge" else "right")
    for edge in corridor.edges:
        lanes = f"{edge.lanes[0]} to {edge.lanes[-1]}"
        table.add_row(escape(edge.name), f"{edge.from_m:.0f}", f"{edge.to_m:.0f}", lanes)
    console.print(table)
    for ramp in corridor.ramps:
        console.print(
            f"on-ramp from {escape(ramp.edge)} into lane {ramp.lane} at {ramp.merge_m:.0f} m"
        )
    for exit_ in corridor.ways_out:
        lanes = ", ".join(map(str, exit_.lanes))
        console.print(f"exit to {escape(exit_.edge)} from lane {lanes} at {exit_.at_m:.0f} m")
    try:
        lines = remarks(found, corridor_tables(found, sumocfg, window))
    except BadInputError as error:
        lines = [f"laneweave cannot drive it: {error}"]
    for line in (*lines, *(f"not used: {remark}" for remark in corridor.unused)):
        console.print(escape(line))
    console.print(f"{len(found.passes)} vehicles in {simulation.duration_s:.0f} s drive through it")
    for reason, count in sorted(found.missing.items()):
        console.print(f"left out: {count} vehicles that {escape(reason)}")
    if simulation.persons:
        console.print(f"left out: {simulation.persons} persons and containers")
