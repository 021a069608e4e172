"""Reads SUMO's configuration files (.sumocfg): which files a simulation consists of."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree as ET

from attrs import field, frozen

from laneweave.protocol.errors import NO_VALUE, BadInputError
from laneweave.sim_bridge.corridors.sumo_statistics import (
    COLLISIONS_FILE,
    CONFLICT_S,
    CONFLICTS_FILE,
    STATISTICS_FILE,
    TRIPS_FILE,
)

_SHORT_NAMES = {
    "n": "net-file",
    "net": "net-file",
    "r": "route-files",
    "a": "additional-files",
    "additional": "additional-files",
    "b": "begin",
    "e": "end",
}
_OPTIONS = frozenset({"processing", "routing", "random_number", "emissions"})
"""Sections of options that determine how vehicles drive."""
ALL_AT_ONCE = {"route-steps": "0"}
"""Option with which SUMO loads all vehicles when it starts, so that it draws the same types."""
CONFLICT_RANGE_M = 30.0
"""Distance within which SUMO looks for vehicles that a vehicle may collide with."""
NO_OPTIONS: Mapping[str, str] = MappingProxyType({})
_DEMAND = frozenset(
    {"vType", "vTypeDistribution", "route", "routeDistribution", "flow", "vehicle", "trip"}
)
"""Elements of additional files that describe vehicles."""


@frozen
class SumoConfig:
    """The files and times of a simulation."""

    file: Path
    net_file: Path
    route_files: tuple[Path, ...] = ()
    additional_files: tuple[Path, ...] = ()
    begin_s: float = 0.0
    end_s: float = math.inf
    step_s: float = 1.0
    """Length of a step."""
    options: Mapping[str, str] = field(factory=dict)
    """Options that determine how vehicles drive, by name."""

    def write_demand(self, folder: Path) -> tuple[Path, ...]:
        """Return the files with the vehicles; those in additional files are copied to a folder.

        Raises:
            BadInputError: a file cannot be read.
        """
        elements = [*self._demand_in_additional_files()]
        if not elements:
            return self.route_files
        copied = folder / "additional.rou.xml"
        copied.write_text("\n".join(["<routes>", *elements, "</routes>"]), encoding="utf-8")
        return (copied, *self.route_files)

    def _demand_in_additional_files(self) -> Iterator[str]:
        """Yield the XML elements of the additional files that describe vehicles.

        Others may describe outputs, which a simulation would write.

        Raises:
            BadInputError: a file cannot be read.
        """
        for file in self.additional_files:
            for element in _parsed("additional-files", file):
                if element.tag in _DEMAND:
                    yield ET.tostring(element, encoding="unicode").strip()


def read_config(file: Path) -> SumoConfig:
    """Read a configuration file; files that it names are relative to its folder.

    Raises:
        BadInputError: it cannot be read, names no network, or a file that does not exist.
    """
    found: dict[str, str] = {}
    options: dict[str, str] = {}
    for section in _parsed("SUMOCFG", file):
        for element in (section, *section):
            value = element.get("value", element.get("v"))
            if value is not None:
                found[_SHORT_NAMES.get(element.tag, element.tag)] = value.strip()
                if section.tag in _OPTIONS:
                    options[element.tag] = value.strip()
    if not found.get("net-file"):
        raise BadInputError("net-file", NO_VALUE, f"the network of {file}")
    return SumoConfig(
        file,
        _files(found, "net-file", file.parent)[0],
        _files(found, "route-files", file.parent),
        _files(found, "additional-files", file.parent),
        _time_s(found, "begin", 0.0),
        _time_s(found, "end", math.inf),
        _time_s(found, "step-length", 1.0),
        options,
    )


def _parsed(field: str, file: Path) -> ET.Element:
    try:
        return ET.parse(file).getroot()  # noqa: S314 - the user's own files, as SUMO reads them
    except OSError as error:
        raise BadInputError(field, str(file), f"a readable file ({error.strerror})") from error
    except (ET.ParseError, ValueError) as error:
        raise BadInputError(field, str(file), f"XML ({error})") from error


def _files(found: Mapping[str, str], name: str, folder: Path) -> tuple[Path, ...]:
    files = [folder / part.strip() for part in found.get(name, "").split(",") if part.strip()]
    for file in files:
        if not file.is_file():
            raise BadInputError(name, str(file), "a file that exists")
    return tuple(files)


def _time_s(found: Mapping[str, str], name: str, default: float) -> float:
    """Return a time [s], given as seconds or [D:]H:M:S; -1 stands for none."""
    text = found.get(name, "")
    try:
        parts = [float(part) for part in text.split(":")] if text else []
    except ValueError:
        raise BadInputError(name, text, "seconds, or H:M:S") from None
    time_s = 0.0
    for number, part in enumerate(parts):
        time_s = time_s * (24.0 if number == 1 and len(parts) == 4 else 60.0) + part
    return time_s if parts and time_s >= 0.0 else default


def sumo_command(
    config: SumoConfig,
    step_s: float,
    seed: int,
    folder: Path,
    results: Path | None,
    conflict_edges: Iterable[str],
    more: Mapping[str, str] = NO_OPTIONS,
) -> Sequence[str]:
    """Return SUMO's command line.

    Args:
        config: the user's simulation.
        step_s: length of a step.
        seed: seed, unless the configuration has one.
        folder: folder for temporary files.
        results: folder for SUMO's statistics; None: none are written.
        conflict_edges: edges on which SUMO reports short times to collision.
        more: further options, by name.
    """
    files = ",".join(map(str, config.write_demand(folder)))
    own: dict[str, str] = {
        **ALL_AT_ONCE,
        **more,
        "net-file": str(config.net_file),
        "begin": str(config.begin_s),
        "step-length": f"{step_s:g}",
        "collision.action": "warn",
        "no-step-log": "true",
        "no-warnings": "true",
        "xml-validation": "never",
        "duration-log.disable": "true",
    }
    if files:
        own["route-files"] = files
    if results is not None:
        # In a queue, the device keeps all pairs of vehicles, tick by tick: 20 GB in half an hour.
        edges = folder / "conflicts.txt"
        lines = [f"edge:{name}\n" for name in sorted(conflict_edges)]
        edges.write_text("".join(lines), encoding="utf-8")
        own["tripinfo-output"] = str(results / TRIPS_FILE)
        own["statistic-output"] = str(results / STATISTICS_FILE)
        own["collision-output"] = str(results / COLLISIONS_FILE)
        own["device.emissions.probability"] = "1"
        own |= {
            "device.ssm.probability": "1",
            "device.ssm.file": str(results / CONFLICTS_FILE),
            "device.ssm.measures": "TTC",
            "device.ssm.thresholds": f"{CONFLICT_S:g}",
            "device.ssm.trajectories": "false",
            "device.ssm.range": f"{CONFLICT_RANGE_M:g}",
            "device.ssm.filter-edges.input-file": str(edges),
        }
    # Drawn vehicles must be those that have been read.
    own["random"] = "false"
    options = {"seed": str(seed % 2**31), **config.options, **own}
    return ("sumo", *(part for name, value in options.items() for part in (f"--{name}", value)))
