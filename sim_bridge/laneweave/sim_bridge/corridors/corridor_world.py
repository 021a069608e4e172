"""A SUMO simulation of which laneweave drives a corridor, as the world of a bridge.

SUMO drives all vehicles outside. A vehicle that departs on the first edge of the corridor waits at
the start of the road, and is added to SUMO when it enters. A vehicle from another edge is driven by
SUMO until it comes to its ramp. Inside, SUMO displays all vehicles where their plants are, on the
lanes of its network. At an exit, at the end of the road, or before a queue, a vehicle is given back
with its speed, and SUMO drives on along its route.

What SUMO drives near the corridor is seen by the sensors of vehicles inside (`others`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from attrs import evolve, frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import Exits
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.bodies.bodies_world import BodiesWorld
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody, pose_of
from laneweave.sim_bridge.corridors.corridor import Corridor
from laneweave.sim_bridge.corridors.corridor_setup import MAX_WAIT_S, CorridorArrival, CorridorSetup
from laneweave.sim_bridge.corridors.corridor_shape import CorridorShape
from laneweave.sim_bridge.corridors.exit_room import SEEN_BEYOND_M
from laneweave.sim_bridge.corridors.hand_over import STANDING_MPS
from laneweave.sim_bridge.corridors.sumo_network import Lane
from laneweave.sim_bridge.corridors.take_over import Approaching
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.sumo.simulation import SumoProcess

_PLANTS = {
    "step-method.ballistic": "true",
    "collision.mingap-factor": "0",
    "time-to-teleport": "-1",
}
"""Options with which SUMO displays bodies as the bridge drives them."""
_OWN_SPEED_MODE, _OWN_LANE_CHANGES = 31, 1621
"""SUMO's defaults: it drives."""
_SLOWING_MODE = 0b1011011
"""The same with a given speed: above the limits of lanes, and braking as hard as is necessary."""
_LANE_CHANGES_OF_ROUTES = 0b011000000001
"""SUMO changes lanes only where the route of a vehicle requires it."""
SLOWS_MPS2, SLOWS_S = 0.5, 5.0
"""Deceleration of a vehicle that is given back before a lower limit, and for how long at most. SUMO
would brake it as hard as its type allows, and a truck one column behind, which is still inside,
would brake in an emergency."""
SLOWING_TAU_S = 0.5
"""Headway that SUMO keeps meanwhile. That of the lattice may be shorter than SUMO's default, 1 s,
and SUMO would brake to lengthen it."""
AT_END_M = 10.0
"""Distance from the end of a lane at which a vehicle cannot change lanes any more."""
MAX_DISPLAY_ERROR_M = 0.1
"""Maximum distance between a body and where SUMO displays it."""


@frozen
class _Slowing:
    """A vehicle that has been given back before a lower speed limit."""

    since_s: float
    """SUMO's time at which it was given back."""
    speed_mps: float
    """Its speed then."""
    limit_mps: float
    """The limit ahead."""
    tau_s: float
    """The headway of its type in SUMO."""


class CorridorWorld(SumoProcess, BodiesWorld):
    """The corridor's vehicles in SUMO. Close it, or use it as a context manager."""

    def __init__(self, setup: CorridorSetup, folder: Path, results: Path | None = None) -> None:
        """Start SUMO.

        Args:
            setup: corridor and scenario.
            folder: folder for temporary files.
            results: folder for SUMO's own statistics; None: none are written.

        Raises:
            SumoUnavailableError: libsumo cannot be loaded.
            SumoFailedError: SUMO rejects a file.
            BadInputError: a lane to which vehicles come from upstream is closed at the start.
        """
        scenario, found, corridor = setup.scenario, setup.found, setup.found.corridor
        entrances = {one.name for one in scenario.entrance}
        if any(one.origin.upstream for one in setup.arrivals):
            entrances.add(MAIN_ENTRANCE)
        ways = [one for one in found.ways_in if one.entrance in entrances]
        self.start_lanes = tuple(one.lane for one in ways if one.entrance == MAIN_ENTRANCE)
        """Lanes to whose beginning vehicles come from upstream."""
        # Checked before SUMO starts, so that no SUMO is left open.
        if closed := {*self.start_lanes} - {*scenario.road.first_lanes}:
            allowed = "lanes that are open at the start, to which vehicles come from upstream"
            raise BadInputError("road.closures", f"lane {min(closed)}", allowed)
        super().__init__(setup.command(folder, results, _PLANTS))
        BodiesWorld.__init__(self)
        self._shape = CorridorShape(corridor)
        self._sumo_name = {one.arrival.vehicle: one.origin.vehicle.name for one in setup.arrivals}
        self._coming = dict(setup.by_name)
        self._setup, self._network = setup, corridor.network
        self._returned: set[str] = set()
        """Names in SUMO of vehicles that have been given back and have not arrived."""
        self._inside: set[str] = set()
        """Those of them that are still on the corridor, and change lanes for their routes only."""
        self._elsewhere: list[Arrival] = []
        """Vehicles that have arrived without coming to their entrances."""
        self._slowing: dict[str, _Slowing] = {}
        """Vehicles that slow down since a lower limit is ahead, by name."""
        geometry = scenario.geometry
        self._ways_in = {
            geometry.entry_point_of(one.ramp) if one.ramp else one.lane: one for one in ways
        }
        """The ways to the entry points to which SUMO drives vehicles."""
        self._watched = frozenset(name for way in ways for name in way.lanes)
        """Lanes on which vehicles come to their entrances."""
        self.departing = tuple(
            one.arrival for one in setup.arrivals if one.near and not one.origin.departs_at_start
        )
        """Vehicles that depart near an entrance, in order of departure."""
        self._beyond = tuple(dict.fromkeys(_beyond(corridor, scenario)))
        self._approaching: dict[int, list[Approaching]] = {}
        """What SUMO has been asked since its last step, by entry point."""
        self._others: list[OtherBody] | None = None
        """The bodies that SUMO drives on the road and behind its exits; None: not asked yet."""

    # --- traffic that SUMO drives -------------------------------------------------------------

    def approaching(self, entry_point: int) -> list[Approaching]:
        """Return the vehicles that come to an entry point, the foremost first."""
        if entry_point not in self._approaching:
            found = self._find_approaching(entry_point) if entry_point in self._ways_in else ()
            self._approaching[entry_point] = sorted(found, key=lambda one: -one.s_m)
        return self._approaching[entry_point]

    def _find_approaching(self, entry_point: int) -> Iterator[Approaching]:
        api, way_in = self.vehicle, self._ways_in[entry_point]
        for name, way in way_in.lanes.items():
            for vehicle in self.lane.getLastStepVehicleIDs(name):
                coming = self._coming.get(vehicle)
                if (
                    coming is not None
                    and coming.arrival.vehicle not in self.states
                    and coming.origin.entrance == way_in.entrance
                ):
                    s_m = way.from_m + api.getLanePosition(vehicle)
                    factor = api.getSpeedFactor(vehicle)
                    limits = tuple((to_m, factor * limit) for to_m, limit in way.limits)
                    speed_mps = api.getSpeed(vehicle)
                    arrival = evolve(
                        coming.arrival,
                        lane=way_in.lane,
                        preferred_lane=coming.origin.preferred_lane(way_in.lane),
                        entry_point=entry_point,
                    )
                    yield Approaching(arrival, s_m, speed_mps, limits, way.upstream)

    def advise(self, vehicle: str, speed_mps: float | None) -> None:
        """Set the speed at which SUMO drives a vehicle, as far as it is safe; None: its own."""
        self.vehicle.setSpeed(self._sumo_name[vehicle], -1.0 if speed_mps is None else speed_mps)

    def keep_lane(self, vehicle: str) -> None:
        """Forbid a vehicle to change lanes, until it is taken over."""
        self.vehicle.setLaneChangeMode(self._sumo_name[vehicle], 0)

    @property
    def exhausted(self) -> bool:
        """Whether no vehicles come to an entrance any more, or they have not come for long."""
        return not self._coming or self.simulation.getTime() >= self._setup.end_s

    @property
    def outside(self) -> Sequence[Arrival]:
        """The vehicles that come from elsewhere and have not been taken over."""
        return [
            *self._elsewhere,
            *(one.arrival for one in self._coming.values() if self._is_outside(one)),
        ]

    def others(self) -> Sequence[OtherBody]:
        """Return the vehicles that SUMO drives on the road and behind its exits."""
        if self._others is None:
            self._others = sorted(self._find_others(), key=lambda one: one.rear_m)
        return self._others

    def _find_others(self) -> Iterator[OtherBody]:
        api = self.vehicle
        for name, (lane, exit_m, from_m) in self._beyond:
            inside = from_m < exit_m
            for vehicle in self.lane.getLastStepVehicleIDs(name):
                coming = self._coming.get(vehicle)
                if inside and coming and (name in self._watched or self._drives(coming)):
                    continue  # on its way to its entrance, or driven here
                length_m = api.getLength(vehicle)
                rear_m = from_m + api.getLanePosition(vehicle) - length_m
                if rear_m <= exit_m + SEEN_BEYOND_M:
                    motion = api.getSpeed(vehicle), api.getAcceleration(vehicle)
                    yield OtherBody(vehicle, lane, exit_m, rear_m, length_m, *motion)

    def _is_outside(self, coming: CorridorArrival) -> bool:
        """Return whether SUMO drives a vehicle to its entrance."""
        return not (coming.origin.departs_at_start or self._drives(coming))

    def _drives(self, coming: CorridorArrival) -> bool:
        """Return whether a vehicle has been taken over."""
        return coming.arrival.vehicle in self.states

    # --- the interface of worlds --------------------------------------------------------------

    def add(self, vehicle: str, state: State, vehicle_type: str = CAR) -> None:
        """Take a vehicle over: one that waits is added to SUMO, another one is driven by SUMO.

        Raises:
            ValueError: the vehicle is already on the road, or its state is not finite.
        """
        super().add(vehicle, state, vehicle_type)
        name = self._sumo_name[vehicle]
        coming, api = self._coming[name], self.vehicle
        if coming.origin.departs_at_start:
            origin = coming.origin.vehicle
            route = f"laneweave.{name}"
            self.route.add(route, list(origin.route))
            kind = origin.type_name
            api.add(name, route, typeID=kind, depart="now", departPos="0", departSpeed="0")
        api.setSpeed(name, -1.0)
        api.setSpeedMode(name, 0)
        api.setLaneChangeMode(name, 0)
        self._approaching.clear()
        self._move(vehicle, state)

    def place(self, vehicle: str, state: State) -> None:
        """Set the state of a vehicle at the end of the next step.

        Raises:
            ValueError: the vehicle is not on the road, or its state is not finite.
        """
        super().place(vehicle, state)
        self._move(vehicle, state)

    def step(self) -> None:
        """Advance SUMO by one tick.

        Raises:
            RuntimeError: SUMO does not display a vehicle where it is (internal error).
        """
        self._advance()
        api = self.vehicle
        self._approaching.clear()
        self._others = None
        for name in self.simulation.getArrivedIDList():
            coming = self._coming.get(name)
            if coming is not None and self._is_outside(coming):
                self._elsewhere.append(self._coming.pop(name).arrival)
        on_road = set(api.getIDList())
        for vehicle, state in self.states.items():
            name = self._sumo_name[vehicle]
            if name not in on_road:
                raise RuntimeError(f"SUMO has lost {name} ({vehicle}) at s = {state[0]:.1f} m")
            (x, y, _), _ = self._shape.at(state[0], state[3])
            error_m = math.dist(api.getPosition(name), (x, y))
            if error_m > MAX_DISPLAY_ERROR_M:
                raise RuntimeError(f"SUMO displays {name} ({vehicle}) {error_m:.2f} m away")
            api.setPreviousSpeed(name, max(state[1], 0.0), state[2])

    def collisions(self) -> list[tuple[str, str]]:
        """Return the sorted pairs that SUMO reports, with a vehicle of the corridor in each."""
        driven = {self._sumo_name[vehicle] for vehicle in self.states}
        return [pair for pair in super().collisions() if not driven.isdisjoint(pair)]

    def remove(self, vehicle: str) -> None:
        """Give a vehicle back to SUMO, with its speed.

        Raises:
            ValueError: the vehicle is not on the road.
        """
        speed_mps = self.states.get(vehicle, (0.0, 0.0))[1]
        super().remove(vehicle)
        name, api = self._sumo_name[vehicle], self.vehicle
        api.setSpeedMode(name, _OWN_SPEED_MODE)
        api.setLaneChangeMode(name, _LANE_CHANGES_OF_ROUTES)
        self._inside.add(name)
        api.setSpeedFactor(name, self._coming[name].origin.vehicle.speed_factor)
        del self._coming[name]
        self._returned.add(name)
        self._others = None
        rest_m = self._rest_m(name)
        if rest_m <= AT_END_M:
            self._correct_route(name)
        limit_mps = self._next_limit_mps(name)
        if speed_mps > limit_mps and rest_m <= SLOWS_S * speed_mps:
            now_s, tau_s = self.simulation.getTime(), api.getTau(name)
            self._slowing[name] = _Slowing(now_s, speed_mps, limit_mps, tau_s)
            api.setSpeedMode(name, _SLOWING_MODE)
            api.setTau(name, min(tau_s, SLOWING_TAU_S))

    def _rest_m(self, name: str) -> float:
        """Return the distance from a vehicle to the end of its lane."""
        rest_m = self.lane.getLength(self.vehicle.getLaneID(name))
        return float(rest_m - self.vehicle.getLanePosition(name))

    def _correct_route(self, name: str) -> None:
        """Give a vehicle that leaves by another exit than its own a route from there.

        SUMO would stop it, or put it in front of others on the next edge of its route. At the end
        of the corridor it may still change lanes.
        """
        api, network = self.vehicle, self._network
        edge, _, index = api.getLaneID(name).rpartition("_")
        if edge not in network.edges or edge == self._setup.found.corridor.edges[-1].name:
            return
        route = api.getRoute(name)
        lane = network.edges[edge].lanes[int(index)]
        ahead = [link.target.edge for link in network.links_from(lane)]
        following = route[route.index(edge) + 1 :] if edge in route else ()
        if not ahead or not following or following[0] in ahead:
            return
        find, kind = self.simulation.findRoute, api.getTypeID(name)
        ways = (find(one, route[-1], kind).edges for one in ahead)
        api.setRoute(name, [edge, *next(filter(None, ways), ahead[:1])])

    def _next_limit_mps(self, name: str) -> float:
        """Return how fast a vehicle may drive on the next edge of its route."""
        api = self.vehicle
        following = api.getRoute(name)[api.getRouteIndex(name) + 1 :][:1]
        edges = self._network.edges
        limits = (lane.speed_mps for edge in following for lane in edges[edge].car_lanes)
        return min(limits, default=math.inf) * float(api.getSpeedFactor(name))

    def _advance(self) -> None:
        """Advance SUMO; vehicles that have been given back before a lower limit slow down."""
        api, now_s = self.vehicle, self.simulation.getTime()
        for name, one in [*self._slowing.items()]:
            slower_mps = one.speed_mps - SLOWS_MPS2 * (now_s - one.since_s)
            if now_s < one.since_s + SLOWS_S and slower_mps > one.limit_mps:
                api.setSpeed(name, slower_mps)
            else:
                api.setSpeed(name, -1.0)
                api.setSpeedMode(name, _OWN_SPEED_MODE)
                api.setTau(name, one.tau_s)
                del self._slowing[name]
        super().step()
        arrived = self.simulation.getArrivedIDList()
        self._returned.difference_update(arrived)
        self._inside.difference_update(arrived)
        for name in arrived:
            self._slowing.pop(name, None)
        edges = self._setup.found.corridor.edge_numbers
        for name in [*self._inside]:
            road = api.getRoadID(name)
            if road not in edges and not road.startswith(":"):  # nor in a junction
                api.setLaneChangeMode(name, _OWN_LANE_CHANGES)
                self._inside.remove(name)
            elif api.getSpeed(name) < STANDING_MPS and self._rest_m(name) <= AT_END_M:
                self._correct_route(name)  # it has not got into the lane of its exit

    def drive_on(self) -> None:
        """Let SUMO drive on until the vehicles that it got back have arrived (statistics)."""
        if self.states or not self.exhausted:
            return  # the run has been interrupted, or vehicles stand inside
        end_s = self.simulation.getTime() + MAX_WAIT_S
        while self._returned and self.simulation.getTime() < end_s:
            self._advance()

    def _move(self, vehicle: str, state: State) -> None:
        """Pass the middle of the front bumper and the angle to SUMO."""
        _, _, heading, _ = pose_of(state)
        (x, y, direction), piece = self._shape.at(state[0], state[3])
        degrees = 90.0 - math.degrees(direction + self._shape.side * heading)
        name = self._sumo_name[vehicle]
        self.vehicle.moveToXY(name, piece.edge, piece.index, x, y, degrees, 2)


def _beyond(
    corridor: Corridor, scenario: Scenario
) -> Iterator[tuple[str, tuple[int, float, float]]]:
    """Yield SUMO's lanes up to the exits and behind: (name, (lane, exit, beginning of the lane)).

    Positions are distances [m] from the start of the road, along the lane of the corridor. Those of
    exits are the scenario's, which are rounded.
    """
    exits = Exits(scenario.geometry.sections, scenario.road.length_m)
    for one in corridor.edges:
        for lane in one.edge.car_lanes:
            number, from_m = one.first_lane + lane.index, one.to_m - lane.length_m
            section = exits.section_at(number, 0.5 * (one.from_m + one.to_m))
            if section is None or not section.exit:
                continue
            yield lane.name, (number, section.to_m, from_m)
            until_m = section.to_m + SEEN_BEYOND_M if one.to_m >= section.to_m else one.to_m
            for ahead, ahead_m in _ahead(corridor, lane, one.to_m, until_m):
                yield ahead, (number, section.to_m, ahead_m)


def _ahead(
    corridor: Corridor, lane: Lane, end_m: float, until_m: float
) -> Iterator[tuple[str, float]]:
    """Yield name and beginning of the lanes behind a lane that ends at a position.

    They begin before `until_m`, and are no lanes of the corridor's edges. Those across the junction
    to the next edge of the corridor are among them.
    """
    for link in corridor.network.links_from(lane):
        leaves = link.target.edge not in corridor.edge_numbers
        if leaves and end_m >= until_m:
            continue
        from_m = end_m
        for across in link.across:
            yield across.name, from_m
            from_m += across.length_m
        if leaves:
            yield link.target.name, from_m
            yield from _ahead(corridor, link.target, from_m + link.target.length_m, until_m)
