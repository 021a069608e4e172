"""`laneweave corridor`: what can be a corridor in a SUMO simulation, and its scenario file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.temporary_folders import temporary_folder

if TYPE_CHECKING:
    from laneweave.sim_bridge.corridors.corridor import Corridor
    from laneweave.sim_bridge.corridors.corridor_search import Candidate
    from laneweave.sim_bridge.corridors.corridor_setup import SumoCorridor
    from laneweave.sim_bridge.corridors.sumo_demand import CorridorDemand

CORRIDOR_HELP = "The corridor's first and last edge."


def corridor(
    sumocfg: Annotated[Path, typer.Argument(metavar="SUMOCFG", help="SUMO's configuration file.")],
    name: Annotated[
        str | None,
        typer.Option("--corridor", metavar="FIRST_EDGE:LAST_EDGE", help=CORRIDOR_HELP),
    ] = None,
    toml: Annotated[
        bool, typer.Option("--toml", help="Print the scenario file of the corridor.")
    ] = False,
) -> None:
    """List what can be a corridor in a SUMO simulation, or describe one."""
    if toml and name is None:
        raise BadInputError("--corridor", "none", "FIRST_EDGE:LAST_EDGE with --toml")
    from laneweave.sim_bridge.corridors.corridor_setup import read_corridor

    with temporary_folder("sumo") as folder:
        if name is None:
            _list(sumocfg, folder)
            return
        found = read_corridor(sumocfg, name, folder)
    if toml:
        import tomli_w

        typer.echo(tomli_w.dumps(corridor_tables(found, sumocfg, name)), nl=False)
        return
    _describe(found, name)


def corridor_tables(found: SumoCorridor, sumocfg: Path, name: str) -> dict[str, Any]:
    """Return the tables of the scenario of a corridor."""
    from laneweave.sim_bridge.corridors.scenario_tables import checked_tables

    tables = checked_tables(found.corridor, found.demand)
    return tables | {"sumo": {"config": str(sumocfg.resolve()), "corridor": name}}


def _list(sumocfg: Path, folder: Path) -> None:
    from laneweave.sim_bridge.corridors.corridor_search import find_corridors
    from laneweave.sim_bridge.corridors.sumo_config import read_config
    from laneweave.sim_bridge.corridors.sumo_demand import read_demand
    from laneweave.sim_bridge.corridors.sumo_network import read_network

    config = read_config(sumocfg)
    network = read_network(config.net_file)
    found = find_corridors(network, read_demand(config, folder))
    if not found:
        raise BadInputError(
            "SUMOCFG", str(sumocfg), "a network with a chain of edges of 500 m with two lanes"
        )
    table = Table(title=f"corridors of {escape(sumocfg.name)}")
    # Names are to be copied, however narrow the terminal is.
    table.add_column("--corridor", min_width=max(len(one.name) for one in found))
    for column in ("edges", "lanes", "m", "m/s", "ramps", "exits", "veh/h"):
        table.add_column(column, justify="right")
    for one in found:
        table.add_row(escape(one.name), *_numbers(one))
    console = Console()
    console.print(table)
    for one in found:
        remark = _remark(one)
        if remark:
            console.print(f"{escape(one.name)}: {escape(remark)}", soft_wrap=True)


def _numbers(one: Candidate) -> tuple[str, ...]:
    corridor = one.corridor
    if corridor is None:
        return ("",) * 7
    return (
        f"{len(corridor.edges)}",
        f"{corridor.lanes}",
        f"{corridor.length_m:.0f}",
        f"{corridor.speed_mps:.1f}",
        f"{len(corridor.ramps)}",
        f"{len(corridor.ways_out)}",
        f"{one.volume_veh_per_h:.0f}",
    )


def _remark(one: Candidate) -> str:
    """Return why laneweave cannot drive a corridor, or what it does not use."""
    corridor, demand = one.corridor, one.demand
    if corridor is None or demand is None:
        return one.problem
    unused = f"{len(corridor.unused)} ways not used" if corridor.unused else ""
    return _problem(corridor, demand) or unused


def _problem(corridor: Corridor, demand: CorridorDemand) -> str:
    """Return why laneweave cannot drive a corridor; empty: it can."""
    from laneweave.sim_bridge.corridors.scenario_tables import checked_tables

    try:
        checked_tables(corridor, demand)
    except BadInputError as error:
        return str(error)
    return ""


def _describe(found: SumoCorridor, name: str) -> None:
    """Print what a corridor consists of."""
    corridor, demand = found.corridor, found.demand
    console = Console()
    table = Table(
        title=f"corridor {escape(name)}: {corridor.lanes} lanes, {corridor.length_m:.0f} m"
    )
    for column in ("edge", "from m", "to m", "lanes"):
        table.add_column(column, justify="left" if column == "edge" else "right")
    for edge in corridor.edges:
        lanes = f"{edge.first_lane} to {edge.first_lane + edge.lanes - 1}"
        table.add_row(escape(edge.name), f"{edge.from_m:.0f}", f"{edge.to_m:.0f}", lanes)
    console.print(table)
    for ramp in corridor.ramps:
        console.print(
            f"on-ramp from {escape(ramp.edge)} into lane {ramp.lane} at {ramp.merge_m:.0f} m"
        )
    for exit_ in corridor.ways_out:
        lanes = ", ".join(map(str, exit_.lanes))
        console.print(f"exit to {escape(exit_.edge)} from lane {lanes} at {exit_.at_m:.0f} m")
    problem = _problem(corridor, demand)
    if problem:
        console.print(f"laneweave cannot drive it: {escape(problem)}")
    for remark in corridor.unused:
        console.print(f"not used: {escape(remark)}")
    console.print(f"{len(demand.passes)} vehicles in {demand.duration_s:.0f} s drive through it")
    for reason, count in sorted(demand.missing.items()):
        console.print(f"left out: {count} vehicles that {escape(reason)}")
