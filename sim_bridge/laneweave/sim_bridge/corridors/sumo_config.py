"""SUMO's configurations (.sumocfg), read by SUMO itself: the options of a simulation.

SUMO writes the configuration with its own names of options, absolute paths and without defaults
(`--save-configuration`). The simulations that laneweave starts add to these options. None writes
the outputs that the configuration asks for.
"""

from __future__ import annotations

import gzip
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from urllib.parse import unquote
from xml.etree import ElementTree as ET

from attrs import field, frozen

from laneweave.protocol.errors import NO_VALUE, BadInputError, Described
from laneweave.sim_bridge.sumo.simulation import SumoFailedError, SumoProcess, first_element

_WITHOUT_EFFECT = frozenset({"output", "report", "traci_server", "gui_only"})
"""Sections of options that do not determine how vehicles drive."""
_OUTPUTS = (".output", "device.ssm.file", "device.toc.file")
"""Ends of the names of options in other sections that name files to be written."""
_REFUSED = {
    "mesosim": "false: laneweave drives bodies on lanes, a mesoscopic simulation has neither",
    "load-state": "none: the vehicles of a state have no departures",
    "no-internal-links": "false: vehicles that laneweave drives need the lanes inside junctions",
}
_GZIP = b"\x1f\x8b"
NO_OPTIONS: Mapping[str, str] = MappingProxyType({})
_DEMAND = frozenset(
    {
        *("vType", "vTypeDistribution", "route", "routeDistribution", "flow", "vehicle", "trip"),
        *("person", "personFlow", "container", "containerFlow", "interval"),
        *("rerouter", "calibrator"),
    }
)
"""Elements of additional files that create vehicles or change their routes."""
_DRAWN = frozenset({"poly", "poi"})
"""Elements that only a window shows."""
_WRITTEN = ("file", "dest", "output")
"""Attributes of elements of additional files that name files to be written."""
_READ = frozenset({"variableSpeedSign", "rerouter"})
"""Elements whose attribute `file` names a file to be read."""


@frozen
class SumoConfig:
    """A simulation as its configuration describes it."""

    file: Path
    net_file: Path
    additional_files: tuple[Path, ...]
    options: Mapping[str, str] = field(hash=False)
    """All options that determine how vehicles drive, by SUMO's names; none with a default."""

    def changed_ns(self) -> tuple[int, ...]:
        """Return when the files were changed that it consists of, as far as they exist."""
        named = [self.file, self.net_file, *self.additional_files]
        named += _paths(self.options.get("route-files", ""))
        return tuple(file.stat().st_mtime_ns for file in named if file.is_file())

    def command(
        self, seed: int, more: Mapping[str, str], without: Sequence[str] = ()
    ) -> tuple[str, ...]:
        """Return SUMO's command line.

        Args:
            seed: SUMO's seed, unless the configuration has one.
            more: more options, by name.
            without: beginnings of the names of options that do not apply.
        """
        options = {
            "seed": f"{seed % 2**31}",
            **{
                name: value
                for name, value in self.options.items()
                if not name.startswith(tuple(without))
            },
            # Equal seeds give equal runs.
            "random": "false",
            "no-step-log": "true",
            "no-warnings": "true",
            "xml-validation": "never",
            "duration-log.disable": "true",
            **more,
        }
        return ("sumo", *(part for name, value in options.items() for part in (f"--{name}", value)))

    def additional(self, folder: Path, *, demand: bool) -> Mapping[str, str]:
        """Return the option with the additional files, copied to a folder without outputs.

        Args:
            folder: where they are written.
            demand: whether elements that create vehicles, or change their routes, are kept.

        Raises:
            BadInputError: a file cannot be read.
        """
        without = _DRAWN if demand else _DRAWN | _DEMAND
        copies = []
        for number, file in enumerate(self.additional_files):
            copy = folder / f"additional{number}{'' if demand else '-without-demand'}.xml"
            root = ET.Element("additional")
            root.extend(_elements(file, without))
            ET.ElementTree(root).write(copy, encoding="utf-8", xml_declaration=True)
            copies.append(str(copy))
        return {"additional-files": ",".join(copies)} if copies else NO_OPTIONS


def read_config(file: Path, folder: Path) -> SumoConfig:
    """Let SUMO read a configuration.

    Args:
        file: the configuration.
        folder: folder for a temporary file.

    Raises:
        BadInputError: it cannot be read, names no network or a file that does not exist, or asks
            for a simulation of another kind.
        CommandFailedError: libsumo is missing.
    """
    _check_kind(file)
    saved = folder / "saved.sumocfg"
    command = ["sumo", "-c", str(file.resolve()), "--save-configuration", str(saved)]
    command += ["--verbose", "false"]  # it would write into the output of laneweave's command
    try:
        SumoProcess(command).close()
    except SumoFailedError as error:
        raise BadInputError("SUMOCFG", str(file), "a configuration that SUMO can read") from error
    options: dict[str, str] = {}
    for section in ET.parse(saved).getroot():  # noqa: S314 (SUMO has written it)
        if section.tag not in _WITHOUT_EFFECT:
            options |= {
                # SUMO writes blanks and other special characters as in URLs.
                option.tag: os.path.expandvars(unquote(option.get("value", "")))
                for option in section
                if not option.tag.endswith(_OUTPUTS)
            }
    for name, allowed in _REFUSED.items():
        if options.get(name, "false") != "false":
            raise BadInputError(f"{name} of {file}", Described(options[name]), allowed)
    if not options.get("net-file"):
        raise BadInputError("net-file", NO_VALUE, f"the network of {file}")
    for name in ("net-file", "route-files", "additional-files"):
        named = _paths(options.get(name, ""))
        for missing in (one for one in named if not one.is_file()):
            raise BadInputError(f"{name} of {file}", str(missing), "a file that exists")
        if named:
            options[name] = ",".join(map(str, named))
    net_file = Path(options["net-file"])
    if first_element("net-file", net_file).tag != "net":
        raise BadInputError("net-file", str(net_file), "a network of SUMO")
    return SumoConfig(
        file.resolve(),
        net_file,
        _paths(options.pop("additional-files", "")),
        options,
    )


def _check_kind(file: Path) -> None:
    """Check that a file is a configuration.

    Raises:
        BadInputError: it cannot be read, or is another file of SUMO.
    """
    kind = first_element("SUMOCFG", file).tag
    kinds = {"net": "a network", "routes": "a file of routes", "additional": "an additional file"}
    if kind in kinds:
        allowed = f"a configuration (.sumocfg) that names it; the file is {kinds[kind]}"
        raise BadInputError("SUMOCFG", str(file), allowed)


def _paths(value: str) -> tuple[Path, ...]:
    """Return the files of a list; blanks behind its commas are not part of their names."""
    found = (Path(part.strip()) for part in value.split(",") if part.strip())
    return tuple(one if one.is_file() else Path(re.sub("/ +", "/", str(one))) for one in found)


def _elements(file: Path, without: Collection[str]) -> Iterator[ET.Element]:
    """Yield the elements of an additional file, and of those that it includes.

    Elements write no files, and files that they read have absolute paths.

    Raises:
        BadInputError: a file cannot be read.
    """
    try:
        data = file.read_bytes()
        root = ET.fromstring(gzip.decompress(data) if data.startswith(_GZIP) else data)  # noqa: S314
    except OSError as error:
        allowed = f"a readable file ({error.strerror or error})"
        raise BadInputError("additional-files", str(file), allowed) from error
    except (ET.ParseError, EOFError, ValueError) as error:
        raise BadInputError("additional-files", str(file), f"XML ({error})") from error
    for element in root:
        if element.tag == "include":
            yield from _elements(file.parent / element.get("href", ""), without)
        elif element.tag not in without:
            for own in element.iter():
                for name in _WRITTEN:
                    if name not in own.attrib:
                        continue
                    read = name == "file" and own.tag in _READ
                    value = file.parent / own.attrib[name] if read else os.devnull
                    own.set(name, str(value))
            yield element
