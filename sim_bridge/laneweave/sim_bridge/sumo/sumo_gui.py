"""Shows a running simulation in sumo-gui.

libsumo has no window. So sumo-gui runs beside it as a second simulation of the same network without
traffic of its own, and shows the vehicles of the first, tick by tick, over TraCI.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

from laneweave.protocol.errors import CommandFailedError

MISSING = "sumo-gui is not installed: pip install 'laneweave[gui]'"
NO_DISPLAY = "sumo-gui needs a screen, and DISPLAY is not set: run without --gui, or with xvfb-run"
_ROUTE, _LABEL = "laneweave", "laneweave-gui"
_EXACT = 2
"""moveToXY puts a vehicle exactly at a position, whatever its route."""


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
        package, traci = importlib.util.find_spec("sumo"), load_traci()
        if package is None or package.origin is None or traci is None:
            raise CommandFailedError(MISSING)
        suffix = ".exe" if sys.platform == "win32" else ""
        binary = Path(package.origin).parent / "bin" / f"{program}{suffix}"
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
        self._refused = traci.exceptions.TraCIException
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


def load_traci() -> Any:  # noqa: ANN401 - optional
    """Return the module traci; None: it is not installed."""
    try:
        import traci  # noqa: PLC0415 (optional)
    except ImportError:
        return None
    return traci
