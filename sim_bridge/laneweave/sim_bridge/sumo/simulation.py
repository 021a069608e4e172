"""SUMO in this process, and its window; the only module that imports libsumo and traci.

libsumo stores its simulation in global variables, so a process can have only one `SumoProcess` at a
time. libsumo is imported when one opens, so that other code works without it.

libsumo has no window. So sumo-gui runs beside it as a second simulation of the same network without
traffic of its own, and shows the vehicles of the first, tick by tick, over TraCI.
"""

from __future__ import annotations

import ctypes
import gzip
import importlib.util
import os
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from laneweave.protocol.errors import BadInputError, CommandFailedError

DEBIAN_PACKAGES = {
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libGL.so.1": "libgl1",
    "libatomic.so.1": "libatomic1",
}
"""System libraries that libsumo loads, and their Debian packages; slim containers lack them."""

MISSING = "sumo-gui is not installed: pip install 'laneweave[gui]'"
NO_DISPLAY = "sumo-gui needs a screen, and DISPLAY is not set: run without --gui, or with xvfb-run"
_ROUTE, _LABEL = "laneweave", "laneweave-gui"
_EXACT = 2
"""moveToXY puts a vehicle exactly at a position, whatever its route."""
_IMPORT_SWITCH = "LIBSUMO_AS_TRACI"


class SumoFailedError(CommandFailedError):
    """SUMO rejects its input; the message is SUMO's."""


class SumoUnavailableError(CommandFailedError):
    """libsumo cannot be loaded; the message names the missing packages."""


class SumoProcess:
    """A running SUMO simulation. Close it, or use it as a context manager."""

    _open: SumoProcess | None = None

    def __init__(self, command: Sequence[str]) -> None:
        """Load libsumo and start SUMO.

        Args:
            command: SUMO's command line, program name included.

        Raises:
            SumoUnavailableError: libsumo cannot be loaded.
            SumoFailedError: SUMO cannot start.
            RuntimeError: another simulation is open in this process.
        """
        if SumoProcess._open is not None:
            raise RuntimeError("libsumo supports one simulation per process, and one is open")
        self._sumo: Any = _load_libsumo()
        try:
            self._sumo.start([*command])
        except Exception as error:
            reason = " ".join(str(error).split())
            raise SumoFailedError(f"SUMO cannot start ({reason}); its messages say why") from error
        SumoProcess._open = self
        # libsumo's interfaces, which have no types.
        self.simulation: Any = self._sumo.simulation
        self.vehicle: Any = self._sumo.vehicle
        self.vehicletype: Any = self._sumo.vehicletype
        self.route: Any = self._sumo.route
        self.edge: Any = self._sumo.edge
        self.lane: Any = self._sumo.lane
        self.trafficlight: Any = self._sumo.trafficlight
        self._gui: SumoGui | None = None

    def show(self, tick_s: float) -> None:
        """Show this simulation in sumo-gui.

        Args:
            tick_s: length of a tick.

        Raises:
            CommandFailedError: sumo-gui is not installed, or cannot start.
        """
        self._gui = SumoGui(Path(self.simulation.getOption("net-file")), tick_s)

    def collisions(self) -> list[tuple[str, str]]:
        """Return the sorted pairs that SUMO reports as colliding in the last step.

        SUMO misses overlaps between lanes; `Bodies.overlapping_pairs` is exact.
        """
        return sorted(
            {
                (min(found.collider, found.victim), max(found.collider, found.victim))
                for found in self._sumo.simulation.getCollisions()
            }
        )

    def step(self) -> None:
        """Advance SUMO by one tick.

        Raises:
            SumoFailedError: SUMO ends, for example since it rejects what it reads while it runs.
        """
        try:
            self._sumo.simulationStep()
        except (self._sumo.TraCIException, self._sumo.FatalTraCIError) as error:
            reason = " ".join(str(error).split())
            raise SumoFailedError(f"SUMO has ended ({reason}); its messages say why") from error
        if self._gui is not None and not self._gui.show(self.vehicle, self.vehicle.getIDList()):
            self._gui.close()
            self._gui = None

    def close(self) -> None:
        """Stop SUMO. Idempotent."""
        if self._gui is not None:
            self._gui.close()
            self._gui = None
        if SumoProcess._open is self:
            SumoProcess._open = None
            self._sumo.close()

    def __enter__(self) -> Self:
        """Return this simulation."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close this simulation."""
        self.close()


def sumo_program(name: str) -> Path | None:
    """Return a program of SUMO; None: the package eclipse-sumo is not installed."""
    try:
        package = importlib.util.find_spec("sumo")
    except ModuleNotFoundError:
        return None
    if package is None or package.origin is None:
        return None
    suffix = ".exe" if sys.platform == "win32" else ""
    return Path(package.origin).parent / "bin" / f"{name}{suffix}"


def check_screen() -> None:
    """Check that there is a screen for a window.

    Raises:
        CommandFailedError: there is none.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        raise CommandFailedError(NO_DISPLAY)


class SumoGui:
    """A window of sumo-gui, to be closed."""

    def __init__(self, network: Path, tick_s: float, program: str = "sumo-gui") -> None:
        """Start sumo-gui, and wait until it has loaded the network.

        Args:
            network: network file of the simulation.
            tick_s: length of a tick.
            program: `sumo-gui`, or `sumo`, which shows nothing (tests).

        Raises:
            CommandFailedError: sumo-gui is not installed, or cannot start.
        """
        if program == "sumo-gui":
            check_screen()
        binary, traci = sumo_program(program), _load_traci()
        if binary is None or traci is None:
            raise CommandFailedError(MISSING)
        command = [str(binary), "--net-file", str(network), "--step-length", f"{tick_s:g}"]
        command += [
            "--collision.action",
            "none",
            "--time-to-teleport",
            "-1",
            "--no-warnings",
            "true",
        ]
        command += ["--no-step-log", "true", "--xml-validation", "never"]
        if program == "sumo-gui":
            command += ["--start", "true", "--quit-on-end", "true", "--delay", "0"]
        self._lost = (traci.exceptions.FatalTraCIError, OSError)
        # Once libsumo is loaded, `traci.exceptions` has its exception instead.
        self._refused = traci.connection.TraCIException
        try:
            traci.start(command, label=_LABEL)
            self._gui: Any = traci.getConnection(_LABEL)
            lanes = (lane for lane in self._gui.lane.getIDList() if not lane.startswith(":"))
            for_cars = (
                one for one in lanes if "passenger" not in self._gui.lane.getDisallowed(one)
            )
            self._gui.route.add(_ROUTE, [self._gui.lane.getEdgeID(next(for_cars))])
        except (*self._lost, self._refused) as error:
            raise CommandFailedError(f"sumo-gui does not start ({error})") from error
        self._shown = set[str]()

    def show(self, vehicles: Any, names: list[str] | tuple[str, ...]) -> bool:  # noqa: ANN401
        """Show vehicles where they are; return whether the window is still open.

        Args:
            vehicles: libsumo's interface to vehicles.
            names: the vehicles on the network.
        """
        try:
            for name in self._shown.difference(names):
                self._gui.vehicle.remove(name)
            for name in names:
                if name not in self._shown:
                    self._add(vehicles, name)
                x_m, y_m = vehicles.getPosition(name)
                lane = vehicles.getLaneID(name)
                edge, _, index = lane.rpartition("_")
                self._gui.vehicle.moveToXY(
                    name, edge, int(index or 0), x_m, y_m, vehicles.getAngle(name), _EXACT
                )
            self._shown = set(names)
            self._gui.simulationStep()
        except (*self._lost, self._refused):
            return False  # the user has closed the window, or sumo-gui cannot show a vehicle
        return True

    def _add(self, vehicles: Any, name: str) -> None:  # noqa: ANN401
        api = self._gui.vehicle
        api.add(name, _ROUTE)
        api.setSpeedMode(name, 0)
        api.setLaneChangeMode(name, 0)
        api.setLength(name, vehicles.getLength(name))
        api.setWidth(name, vehicles.getWidth(name))
        api.setVehicleClass(name, vehicles.getVehicleClass(name))
        api.setColor(name, vehicles.getColor(name))

    def close(self) -> None:
        """Close the window, unless the user has done so."""
        try:
            self._gui.close()
        except self._lost:
            return


def first_element(field: str, file: Path) -> ET.Element:
    """Return the outermost element of an XML file with its attributes, not its content.

    Args:
        field: what the file is, for errors.
        file: the file, compressed if its name ends with `.gz`.

    Raises:
        BadInputError: it cannot be read, or is no XML.
    """
    try:
        with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as stream:
            found: ET.Element = next(ET.iterparse(stream, events=("start",)))[1]  # noqa: S314
    except (ET.ParseError, StopIteration, EOFError, gzip.BadGzipFile) as error:
        raise BadInputError(field, str(file), f"XML ({error})") from error
    except OSError as error:
        allowed = f"a readable file ({error.strerror or error})"
        raise BadInputError(field, str(file), allowed) from error
    return found


def _load_traci() -> Any:  # noqa: ANN401 - optional
    """Return the module traci; None: it is not installed."""
    try:
        import traci  # noqa: PLC0415 (optional)
    except ImportError:
        return None
    return traci


def _load_libsumo() -> Any:  # noqa: ANN401 - libsumo has no types
    """Import libsumo without its warning about the version of pyarrow.

    The warning concerns SUMO's Parquet output, which is not used. libsumo and pyarrow were tested
    together, imported in either order.
    """
    _load_traci()  # before the switch, which also makes traci an alias of libsumo
    previous = os.environ.get(_IMPORT_SWITCH)
    os.environ[_IMPORT_SWITCH] = "quiet"
    try:
        import libsumo  # noqa: PLC0415 - see the module
    except (ImportError, OSError) as error:
        raise SumoUnavailableError(_advice(error)) from error
    else:
        return libsumo
    finally:
        if previous is None:
            del os.environ[_IMPORT_SWITCH]
        else:
            os.environ[_IMPORT_SWITCH] = previous


def _advice(error: Exception) -> str:
    """Return a message with the packages that must be installed."""
    if isinstance(error, ModuleNotFoundError):
        return "libsumo is not installed: pip install 'laneweave[sim]'"
    missing = [package for library, package in DEBIAN_PACKAGES.items() if not _loads(library)]
    if missing:
        return f"libsumo lacks system libraries: apt-get install {' '.join(missing)} ({error})"
    return f"libsumo cannot be loaded: {error}; it needs {' '.join(DEBIAN_PACKAGES.values())}"


def _loads(library: str) -> bool:
    """Return whether the dynamic loader finds a shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
