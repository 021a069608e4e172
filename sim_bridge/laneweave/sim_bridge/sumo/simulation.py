"""SUMO in this process; the only module that imports libsumo.

libsumo stores its simulation in global variables, so a process can have only one `SumoProcess` at a
time. libsumo is imported when one opens, so that other code works without it.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from laneweave.protocol.errors import CommandFailedError
from laneweave.sim_bridge.sumo.sumo_gui import SumoGui, load_traci

DEBIAN_PACKAGES = {
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libGL.so.1": "libgl1",
    "libatomic.so.1": "libatomic1",
}
"""System libraries that libsumo loads, and their Debian packages; slim containers lack them."""

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


def _load_libsumo() -> Any:  # noqa: ANN401 - libsumo has no types
    """Import libsumo without its warning about the version of pyarrow.

    The warning concerns SUMO's Parquet output, which is not used. libsumo and pyarrow were tested
    together, imported in either order.
    """
    load_traci()  # before the switch, which also makes traci an alias of libsumo
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
