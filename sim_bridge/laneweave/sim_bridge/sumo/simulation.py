"""SUMO in this process; the only module that imports libsumo.

libsumo stores its simulation in global variables, so a process can have only one `SumoSession` at a
time. libsumo is imported when a session opens, so that other code works without it.
"""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Self

from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose
from laneweave.sim_bridge.sumo.network import write_network

DEBIAN_PACKAGES = {
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libGL.so.1": "libgl1",
    "libatomic.so.1": "libatomic1",
}
"""System libraries that libsumo loads, and their Debian packages; slim containers lack them."""

_IMPORT_SWITCH = "LIBSUMO_AS_TRACI"


class SumoUnavailableError(CommandFailedError):
    """libsumo cannot be loaded; the message names the missing packages."""


class SumoSession:
    """A running SUMO simulation. Close it, or use it as a context manager."""

    _open: SumoSession | None = None

    def __init__(self, scenario: Scenario, folder: Path, *, sumo_drives: bool = False) -> None:
        """Load libsumo, write the network and start SUMO.

        Args:
            scenario: road, vehicles and tick.
            folder: folder for SUMO's input files.
            sumo_drives: whether SUMO drives; see `write_network`.

        Raises:
            SumoUnavailableError: libsumo cannot be loaded.
            RuntimeError: another session is open in this process.
        """
        if SumoSession._open is not None:
            raise RuntimeError("libsumo supports one simulation per process, and one is open")
        self._sumo: Any = _load_libsumo()
        self._sumo.start([*write_network(scenario, folder, sumo_drives=sumo_drives)])
        self._types = scenario.types
        self._half_bodies_m: dict[str, float] = {}
        SumoSession._open = self

    @property
    def vehicle(self) -> Any:  # noqa: ANN401 - libsumo has no types
        """Interface to SUMO's vehicles in libsumo."""
        return self._sumo.vehicle

    def set_type(self, vehicle: str, vehicle_type: str) -> None:
        """Set the type of a vehicle that is about to be added."""
        self._half_bodies_m[vehicle] = 0.5 * self._types[vehicle_type].vehicle.length_m

    def forget(self, vehicle: str) -> None:
        """Remove a vehicle from SUMO."""
        del self._half_bodies_m[vehicle]
        self.vehicle.remove(vehicle)

    def half_body_m(self, vehicle: str) -> float:
        """Return half of the length of a vehicle's body."""
        return self._half_bodies_m[vehicle]

    def step(self) -> None:
        """Advance SUMO by one tick."""
        self._sumo.simulationStep()

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

    def poses(self, vehicles: Iterable[str]) -> dict[str, Pose]:
        """Return the poses of vehicles after the last step."""
        api = self.vehicle
        position, angle, speed = api.getPosition, api.getAngle, api.getSpeed
        poses = {}
        for vehicle in vehicles:
            s_m, front_y_m = position(vehicle)
            heading = math.radians(90.0 - angle(vehicle))
            y_m = front_y_m - self._half_bodies_m[vehicle] * math.sin(heading)
            poses[vehicle] = (s_m, y_m, heading, speed(vehicle))
        return poses

    def close(self) -> None:
        """Stop SUMO. Idempotent."""
        if SumoSession._open is self:
            SumoSession._open = None
            self._sumo.close()

    def __enter__(self) -> Self:
        """Return this session."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close this session."""
        self.close()


def _load_libsumo() -> Any:  # noqa: ANN401 - libsumo has no types
    """Import libsumo without its warning about the version of pyarrow.

    The warning concerns SUMO's Parquet output, which is not used. libsumo and pyarrow were tested
    together, imported in either order.
    """
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
