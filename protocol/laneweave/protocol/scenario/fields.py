"""The scenario: one TOML file for world and deployment, read by every role.

Every field has its unit in its name, a checked range, and a default: the paper's value (Table
"Simulation parameters") if there is one. `config` reads the file and checks the rules between
fields.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any, Final

import attrs
from attrs import field, frozen
from attrs.validators import optional

from laneweave.protocol.errors import BadInputError, unknown_name
from laneweave.protocol.field_validators import key_part, one_of, within
from laneweave.protocol.lattice import Cell, Lattice, displacements
from laneweave.protocol.names import NAME_PATTERN
from laneweave.protocol.road_layout import (
    ANY_LANE,
    END_OF_ROAD,
    LaneChange,
    LaneSection,
    open_sections,
    sections_for,
)
from laneweave.protocol.scenario.deployment_fields import (
    Network,
    Observation,
    Security,
    Service,
    SumoSettings,
)
from laneweave.protocol.wire.bounds import Bounds
from laneweave.protocol.wire.events import STREAM_PLANNED
from laneweave.protocol.wire.messages import CAR

SCHEMA = "laneweave.scenario/1"

BASE_CONFLICTS = ("node", "edge", "special-1")
DEFAULT_CONFLICTS: Mapping[int, tuple[str, ...]] = MappingProxyType(
    {1: BASE_CONFLICTS, 2: ("geometric",)}
)
"""Conflict kinds that planners avoid by default, by mode; formations also avoid `closing`."""
SNAPSHOT_S = 0.5
"""Time into a slot at which all its moves have begun and been reported.

The rolling operation plans the next slot one tick later, from the states up to this time, all of
which have arrived by then. So plans do not depend on message delays."""
READY_LATE_S = 1.2
"""Time into a slot until which a vehicle may become ready for the move that it makes in it."""
GAP_AHEAD_M = 9.0
"""Least net gap of a vehicle that changes lanes while it still falls back to its cell."""
MAX_ROOM_AHEAD_M = 6.0
"""Maximum distance from which it falls back meanwhile."""
SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 4.0, 7.0
"""Range of T_F if `formation.cycle_s` is not set; the lower end is the paper's value."""
COMFORT_MPS2 = 3.0
"""Maximum comfortable acceleration, along and across the road."""
ROLLING_CYCLE_S = 6.0
MIN_MERGING_SLOTS = 4
"""Number of slots that the rolling operation should have in a lane that begins and ends on the
road, as that of a ramp; with three, up to 1 % of the vehicles did not change lanes in time at 2000
vehicles/(lane h)."""
COMFORTABLE_VOLUME_VEH_PER_LANE_H = 2000.0
"""Maximum volume at which T_F of the rolling operation is the comfortable `ROLLING_CYCLE_S`. Denser
traffic needs more steps on the same road: at 2400, 1 % of the vehicles miss their lanes with 6 s,
but less than 0.1 % with 4 s (`benchmarks/stream.py`)."""
CYCLE_STEP_S = 0.2
"""Step between values of T_F; few values keep the number of planned trajectories low."""
FORMATION_CLOSING_MPS = 8.0
"""Speed at which a member of a formation may close up to another if T_F is not given; vehicles can
brake from it in nearly all scenarios."""
SLACK_S = 0.2
"""Part of T_F without motion if `formation.move_s` is not set."""
LOWEST_PACE, HIGHEST_PACE = 0.01, 1000.0
"""Bounds of `runtime.max_pace`."""
LONGEST_ROAD_M = 60_000.0
"""Upper bound on positions on the road: the sum of those of its three segments."""
MAX_HORIZON_TICKS = 200
"""Maximum horizon of the tracker."""
MAIN_ENTRANCE: Final = "main"
"""Name of the entrance at the start of the road."""

PAPERS_FORMATIONS: Mapping[str, object] = MappingProxyType(
    {"entry": "interlaced", "close": "columns", "cycle_s": 4.0}
)
"""Values of the table `formation` that the former `operation = "paper"` selects."""

SOLVERS: Final = ("tappa", "branching")
"""Built-in solvers. `tappa`: the paper's algorithm. `branching`: branch and bound, for large
formations. Coordinators may have others (`laneweave.coordinator.planning.plug_ins`)."""
DEFAULT_SOLVER: Final = "tappa"
ROLLING_SOLVER: Final = "rolling"
"""Name of the rolling operation's planner in counts of plans by solver."""
CONFLICT_KINDS = (
    "node",
    "edge",
    "special-1",
    "special-2",
    "special-3",
    "special-4",
    "geometric",
    "closing",
)


def check_pace(pace: float | None, name: str) -> None:
    """Check a pace that replaces `runtime.max_pace`; None: it replaces nothing.

    Raises:
        BadInputError: the pace is out of range; names the option or argument `name`.
    """
    if pace is not None and not LOWEST_PACE <= pace <= HIGHEST_PACE:
        raise BadInputError(name, pace, f"[{LOWEST_PACE:g}, {HIGHEST_PACE:g}]")


def solver_of_event(kind: str, data: Mapping[str, Any]) -> str | None:
    """Return the solver that an event reports, if any."""
    if kind == STREAM_PLANNED:
        return ROLLING_SOLVER
    solver = data.get("solver")
    return solver if isinstance(solver, str) and NAME_PATTERN.fullmatch(solver) else None


def _conflict_kinds(_: object, attribute: attrs.Attribute[Any], value: Sequence[str]) -> None:
    for kind in value:
        if kind not in CONFLICT_KINDS:
            allowed = "any of " + ", ".join(CONFLICT_KINDS)
            raise unknown_name(attribute.name, kind, CONFLICT_KINDS, allowed)


@frozen
class Closure:
    """A part of a lane that is closed."""

    lane: int = field(validator=within(0, 7))
    from_m: float = field(default=0.0, validator=within(0.0, LONGEST_ROAD_M))
    """Where it begins; by default, the lane is closed from the start of the road."""
    to_m: float = field(
        default=LONGEST_ROAD_M, validator=within(0.0, LONGEST_ROAD_M, open_low=True)
    )
    """Where the lane is open again; by default, it is not."""


@frozen
class Restriction:
    """A part of a lane in which vehicles of some types may not drive."""

    lane: int = field(validator=within(0, 7))
    vehicle_types: tuple[str, ...]
    from_m: float = field(default=0.0, validator=within(0.0, LONGEST_ROAD_M))
    """Where it begins; by default, at the start of the road."""
    to_m: float = field(
        default=LONGEST_ROAD_M, validator=within(0.0, LONGEST_ROAD_M, open_low=True)
    )
    """Where it ends; by default, at the end of the road."""

    def applies_to(self, vehicle_type: str) -> bool:
        """Return whether vehicles of a type may not drive there."""
        return vehicle_type in self.vehicle_types

    @property
    def changes(self) -> tuple[LaneChange, ...]:
        """The lane changes that it forbids: those into the lane."""
        return (self.lane - 1, self.lane), (self.lane + 1, self.lane)


@frozen
class SolidLine:
    """A line beside a part of a lane that vehicles may not cross from this lane."""

    lane: int = field(validator=within(0, 7))
    to: str = field(validator=one_of("left", "right"))
    """The side of the lane on which the line is."""
    from_m: float = field(default=0.0, validator=within(0.0, LONGEST_ROAD_M))
    """Where it begins; by default, at the start of the road."""
    to_m: float = field(
        default=LONGEST_ROAD_M, validator=within(0.0, LONGEST_ROAD_M, open_low=True)
    )
    """Where it ends; by default, at the end of the road."""
    vehicle_types: tuple[str, ...] = ()
    """Types that may not cross it; empty: all types."""

    def applies_to(self, vehicle_type: str) -> bool:
        """Return whether vehicles of a type may not cross the line."""
        return not self.vehicle_types or vehicle_type in self.vehicle_types

    @property
    def changes(self) -> tuple[LaneChange, ...]:
        """The lane change that it forbids."""
        return ((self.lane, self.lane + (1 if self.to == "left" else -1)),)


LaneRule = Restriction | SolidLine


@frozen
class Road:
    """The road: segments S1 (entry), S2 (driving), S3 (lane sorting); paper, Section 5.2.1."""

    lanes: int = field(default=3, validator=within(1, 8))
    lane_width_m: float = field(default=3.5, validator=within(2.0, 10.0))
    s1_m: float = field(default=50.0, validator=within(0.0, 20_000.0))
    s2_m: float = field(default=350.0, validator=within(0.0, 20_000.0))
    s3_m: float = field(default=600.0, validator=within(0.0, 20_000.0, open_low=True))
    closures: tuple[Closure, ...] = ()
    """Parts of lanes in which no vehicle may drive."""
    restrictions: tuple[Restriction, ...] = ()
    """Parts of lanes in which vehicles of some types may not drive."""
    solid_lines: tuple[SolidLine, ...] = ()
    """Lines that vehicles may not cross."""

    @property
    def length_m(self) -> float:
        """Total length of the road."""
        return self.s1_m + self.s2_m + self.s3_m

    @property
    def sorting_start_m(self) -> float:
        """Position at which S3 and lane changes begin."""
        return self.s1_m + self.s2_m

    @property
    def first_lanes(self) -> tuple[int, ...]:
        """Lanes that are open at the start of the road."""
        closed = {closure.lane for closure in self.closures if closure.from_m <= 0.0}
        return tuple(lane for lane in range(self.lanes) if lane not in closed)


@frozen
class DestinationShare:
    """The share of an entrance's vehicles that leave by an exit."""

    exit: str
    share: float = field(validator=within(0.0, 1.0))


@frozen
class TypeShare:
    """The share of a type among the vehicles of an entrance."""

    type: str
    share: float = field(validator=within(0.0, 1.0))


@frozen
class Exit:
    """An exit before the end of the road, by which vehicles leave."""

    name: str = field(validator=key_part)
    lanes: tuple[int, ...]
    """Lanes that end there, each of them closed from there on."""
    at_m: float = field(validator=within(0.0, LONGEST_ROAD_M, open_low=True))


@frozen
class Entrance:
    """An on-ramp: a lane in which vehicles enter the road behind its start.

    The ramp is the part of the lane from `at_m` to `merge_m`. The demand's minimum headway applies.
    """

    name: str = field(validator=key_part)
    lane: int = field(validator=within(0, 7))
    at_m: float = field(validator=within(0.0, LONGEST_ROAD_M, open_low=True))
    """Where vehicles enter with speed v_F, each in a cell of the lattice; the lane opens there."""
    merge_m: float = field(validator=within(0.0, LONGEST_ROAD_M, open_low=True))
    """Where the ramp joins the road: lane changes to and from its lane are possible from there."""
    volume_veh_per_h: float = field(validator=within(0, 3600, open_low=True))
    destinations: tuple[DestinationShare, ...] = ()
    """Shares of vehicles that leave by exits; the others leave at the end of the road."""
    lane_shares: tuple[float, ...] = ()
    """Shares of preferred lanes among the others; empty: `demand.lane_shares`, which must be given
    if this is."""
    vehicle_types: tuple[TypeShare, ...] = ()
    """Shares of types, the others are cars; empty: those of `vehicle_type`."""


@frozen
class Demand:
    """Random arrivals in each lane: minimum plus exponential headways with mean 3600 / volume."""

    volume_veh_per_lane_h: float = field(default=1000.0, validator=within(0, 3600, open_low=True))
    duration_s: float = field(default=300.0, validator=within(0, 86_400, open_low=True))
    min_headway_s: float = field(default=1.0, validator=within(0.0, 60.0))
    arrival_shares: tuple[float, ...] = ()
    """Share of the vehicles that arrive in each lane at the start of the road, on any scale; empty:
    equal shares. Their mean volume is `volume_veh_per_lane_h`."""
    lane_shares: tuple[float, ...] = ()
    """Share of vehicles that prefer each lane at the end of the road; empty: equal shares, and on a
    road with closures no preferences."""
    destinations: tuple[DestinationShare, ...] = ()
    """Shares of vehicles that leave by exits before the end of the road; the others leave there."""


@frozen
class DrivingStructure:
    """A geometric structure in which formations drive before they sort (paper, Section 2.2)."""

    from_m: float = field(validator=within(0.0, LONGEST_ROAD_M))
    """Formations change to this structure once their rear has passed this position."""
    structure: str = field(validator=one_of("parallel", "interlaced"))
    lanes: tuple[int, ...] = ()
    """Lanes that the structure uses; empty: all lanes."""


@frozen
class FormationSettings:
    """Formation control parameters d_F, T_F and v_F, and settings of the planner."""

    operation: str = field(default="formations", validator=one_of("formations", "rolling"))
    """`formations`: closed formations, each sorted by one plan, as in the paper. `rolling`: no
    formations; the whole stream is replanned in each slot."""
    entry: str = field(default="free", validator=one_of("free", "interlaced"))
    """Cells that vehicles may enter in formations: all, or those of the interlaced structure."""
    close: str = field(default="vehicles", validator=one_of("vehicles", "columns"))
    """When a formation closes. `vehicles`: at `max_vehicles` vehicles or `max_columns` columns.
    `columns`: each has `block_columns` columns, as in the paper."""
    gap_m: float = field(default=15.0, validator=within(1.0, 200.0))
    """Column pitch d_F."""
    cycle_s: float | None = field(default=None, validator=optional(within(0.5, 60.0)))
    """T_F, the time slot of a step. None: in formations the longest from 4 to 7 s for which the
    road suffices, in the rolling operation a value by volume, and by the length of lanes that
    begin and end on the road, within limits (`Scenario.cycles_s`)."""
    move_s: float | None = field(default=None, validator=optional(within(0.5, 60.0)))
    """Duration of a move within its slot; the rest is slack for lost messages. None: 0.2 s less
    than T_F."""
    speed_mps: float = field(default=15.0, validator=within(1.0, 60.0))
    """v_F, the speed of the lattice."""
    settle_s: float = field(default=10.0, validator=within(1.0, 60.0))
    """Time from when a vehicle enters until it has settled in its cell."""
    sort_in_s2: bool = False
    """Rolling operation: settled vehicles also change lanes in S2."""
    reward_drift: bool = False
    """Rolling operation: reward forward moves that cost no other vehicle anything."""
    change_columns: bool = True
    """Rolling operation: vehicles also move between columns. False: only between lanes."""
    block_columns: int = field(default=4, validator=within(1, 24))
    """Number of columns of a formation if `close` is `columns`."""
    max_columns: int = field(default=7, validator=within(1, 24))
    """Maximum length of a formation if `close` is `vehicles`."""
    max_vehicles: int = field(default=6, validator=within(1, 36))
    """Maximum size of a formation (paper: six)."""
    max_joined: int = field(default=1, validator=within(1, 4))
    """Maximum number of neighbouring formations in one ballot."""
    join: str = field(default="needed", validator=one_of("needed", "room"))
    """Condition for joining neighbouring formations. `needed`: one alone has too little room to
    sort. `room`: also if the vehicles of both fit into one formation."""
    structures: tuple[DrivingStructure, ...] = ()
    """Structures that formations take on in turn before they sort in S3; empty: vehicles stay in
    the cells in which they entered."""
    mode: int = field(default=1, validator=one_of(1, 2))
    """Relative motion mode."""
    conflicts: tuple[str, ...] = field(default=(), validator=_conflict_kinds)
    """Conflict kinds that the planner avoids; empty: those of the mode, and `closing`."""
    weight_straight: int = field(default=1, validator=one_of(0, 1))
    """l_s of the formation relative distance."""
    weight_oblique: int | None = field(default=None, validator=one_of(None, 0, 1, 2))
    """l_o of the formation relative distance; None: the number of steps of an oblique edge."""
    solver: str = field(default=DEFAULT_SOLVER, validator=key_part)
    """Solver of formations, and of service requests that do not name one: built in, or a plug-in
    that the coordinators have installed."""
    planning_deadline_s: float | None = field(
        default=None, validator=optional(within(0.01, 3600.0))
    )
    """Maximum planning time; None: the time until the first move could begin, 1 to 15 s. On most
    machines `max_nodes` is reached first."""
    max_nodes: int = field(default=20_000, validator=within(1, 100_000_000))
    """Maximum number of search nodes per plan, independent of the machine's speed."""

    @property
    def rolling(self) -> bool:
        """Whether the rolling operation is selected."""
        return self.operation == "rolling"

    @property
    def interlaced(self) -> bool:
        """Whether vehicles may enter only the cells of the interlaced structure."""
        return not self.rolling and self.entry == "interlaced"

    @property
    def closes_by_vehicles(self) -> bool:
        """Whether the length of formations depends on the traffic."""
        return not self.rolling and self.close == "vehicles"

    @property
    def block_width(self) -> int:
        """Number of columns of a block; a formation owns one or more blocks."""
        return 1 if self.closes_by_vehicles else self.block_columns

    @property
    def max_length(self) -> int:
        """Maximum number of columns of a formation."""
        return self.max_columns if self.closes_by_vehicles else self.block_columns

    @property
    def slack_s(self) -> float:
        """Part of T_F without motion."""
        if self.cycle_s is None or self.move_s is None:
            return SLACK_S
        return self.cycle_s - self.move_s

    @property
    def entry_spacing_s(self) -> float:
        """Time between successive cells of a lane that vehicles may enter."""
        return (2.0 if self.interlaced else 1.0) * self.gap_m / self.speed_mps

    @property
    def bound_veh_per_lane_h(self) -> float:
        """Maximum flow [vehicles/(lane h)]: one vehicle for each cell that vehicles may enter.

        V_u = 3600 v_F / (2 d_F) with interlaced entry (paper, Section 5.2.3), twice that with free
        entry.
        """
        return 3600.0 / self.entry_spacing_s

    @property
    def entry_spread_s(self) -> float:
        """Maximum time between a vehicle and its cell as they pass the start of the road.

        With half of the time between two cells, a vehicle waits only if it is too close behind
        another vehicle. Formations use three quarters: vehicles catch up with cells left empty, so
        queues dissolve sooner.
        """
        return (0.5 if self.rolling else 0.75) * self.entry_spacing_s

    @property
    def oblique_steps(self) -> int:
        """Number of steps of an oblique edge: the largest l_o that is still a lower bound."""
        return 2 if self.mode == 1 else 1

    @property
    def conflict_kinds(self) -> tuple[str, ...]:
        """Conflict kinds that the planner avoids, defaults included."""
        if self.conflicts:
            return self.conflicts
        return (*DEFAULT_CONFLICTS[self.mode], "closing")

    @property
    def executable(self) -> bool:
        """Whether moves of one step have disjoint footprints, so that no timetable is needed."""
        kinds = set(self.conflict_kinds)
        return "geometric" in kinds or (self.mode == 1 and set(BASE_CONFLICTS) <= kinds)


def formation_columns(vehicles: int, lanes: int) -> int:
    """Return the minimum number of columns of a formation.

    With several lanes, at least as many cells as there are lanes stay free.

    Args:
        vehicles: number of vehicles.
        lanes: number of lanes; where some end, those that remain.
    """
    return math.ceil((vehicles + lanes) / lanes) if lanes > 1 else vehicles


@frozen
class Vehicle:
    """Size and limits of a car, and of other types of vehicles where they have no own values."""

    length_m: float = field(default=5.0, validator=within(1.0, 30.0))
    width_m: float = field(default=1.8, validator=within(0.5, 4.0))
    max_speed_mps: float = field(default=25.0, validator=within(1.0, 80.0))
    min_accel_mps2: float = field(default=-10.0, validator=within(-20.0, -0.1))
    max_accel_mps2: float = field(default=5.0, validator=within(0.1, 20.0))
    max_jerk_mps3: float = field(default=15.0, validator=within(0.1, 100.0))
    max_lateral_accel_mps2: float = field(default=3.0, validator=within(0.1, 20.0))
    max_lateral_jerk_mps3: float = field(default=8.0, validator=within(0.1, 100.0))
    max_slip_ratio: float = field(default=0.25, validator=within(0.01, 1.0))
    """Maximum ratio of lateral to forward speed."""
    actuator_lag_s: float = field(default=0.2, validator=within(0.0, 2.0))
    """Time constant of the first-order lag from the acceleration set-point to the acceleration."""
    lateral_actuator_lag_s: float = field(default=0.1, validator=within(0.0, 2.0))

    @property
    def size_m(self) -> tuple[float, float]:
        """Length and width."""
        return self.length_m, self.width_m


@frozen
class VehicleType:
    """A type of vehicle other than cars; for values that are not set, those of cars apply."""

    name: str = field(validator=key_part)
    share: float = field(validator=within(0.0, 1.0))
    """Share of vehicles of this type, at entrances without shares of their own."""
    length_m: float | None = field(default=None, validator=optional(within(1.0, 30.0)))
    width_m: float | None = field(default=None, validator=optional(within(0.5, 4.0)))
    min_accel_mps2: float | None = field(default=None, validator=optional(within(-20.0, -0.1)))
    max_accel_mps2: float | None = field(default=None, validator=optional(within(0.1, 20.0)))
    """A move by a column that needs more is not planned for the type."""
    max_jerk_mps3: float | None = field(default=None, validator=optional(within(0.1, 100.0)))
    max_lateral_accel_mps2: float | None = field(
        default=None, validator=optional(within(0.1, 20.0))
    )
    max_lateral_jerk_mps3: float | None = field(
        default=None, validator=optional(within(0.1, 100.0))
    )

    def resolved(self, cars: Vehicle) -> VehicleType:
        """Return the type with a value for every limit, given the limits of cars."""
        missing = {
            one.name: getattr(cars, one.name)
            for one in attrs.fields(VehicleType)
            if getattr(self, one.name) is None
        }
        return attrs.evolve(self, **missing)

    def limits(self, cars: Vehicle) -> Vehicle:
        """Return size and limits of the type, given those of cars."""
        own = attrs.asdict(self.resolved(cars))
        del own["name"], own["share"]
        return attrs.evolve(cars, **own)


@frozen
class Sensing:
    """Standard deviations of the measurement errors, which are drawn at each tick."""

    position_noise_m: float = field(default=0.05, validator=within(0.0, 5.0))
    lateral_noise_m: float = field(default=0.02, validator=within(0.0, 1.0))
    speed_noise_mps: float = field(default=0.02, validator=within(0.0, 2.0))
    """Own speed, along and across the road."""
    accel_noise_mps2: float = field(default=0.05, validator=within(0.0, 2.0))
    """Own acceleration, along and across the road."""
    gap_noise_m: float = field(default=0.05, validator=within(0.0, 2.0))
    """Gap to another vehicle."""
    other_speed_noise_mps: float = field(default=0.03, validator=within(0.0, 2.0))
    other_accel_noise_mps2: float = field(default=0.2, validator=within(0.0, 5.0))


@frozen
class Braking:
    """Assumptions of the emergency brake about the vehicle ahead and about delays."""

    lead_brake_mps2: float = field(default=10.0, validator=within(0.1, 30.0))
    """Hardest braking of the vehicle ahead."""
    lead_lag_s: float = field(default=0.2, validator=within(0.0, 2.0))
    """Minimum time constant of the first-order lag of the brakes of the vehicle ahead."""
    reaction_s: float = field(default=0.1, validator=within(0.01, 5.0))
    """Time from a measurement to the brakes' set-point: one tick, plus delays of sensors and brakes
    in multiples of a tick (none in this plant)."""
    margin_m: float = field(default=0.3, validator=within(0.0, 10.0))
    """Net gap at standstill; measurement errors reduce it."""


@frozen
class Tracking:
    """The tracking controller of the lower level."""

    horizon_ticks: int | None = field(
        default=None, validator=optional(within(10, MAX_HORIZON_TICKS))
    )
    """Horizon of the tracker; None: the longest T_F."""
    min_gap_m: float = field(default=3.0, validator=within(0.0, 100.0))
    """Minimum net gap to the vehicle ahead; takes precedence over the reference."""
    always_solve: bool = False
    """Solve the quadratic program with OSQP in every tick, even if its unconstrained solution
    satisfies all constraints."""


@frozen
class RuleSettings:
    """The rule-based reference method (paper, Section 5.2.2; decision 20 interprets it)."""

    standstill_gap_m: float = field(default=5.0, validator=within(0.0, 100.0))
    """d_0 in d_R = d_0 + v tau (called d_R in the paper's table)."""
    headway_s: float = field(default=0.66, validator=within(0.0, 10.0))
    """tau in d_R = d_0 + v tau."""
    stop_distance_m: float = field(default=150.0, validator=within(1.0, 20_000.0))
    """d_stop: distance from the end within which yielding vehicles stop (paper's table: d_end)."""
    gap: str = field(default="front-to-front", validator=one_of("front-to-front", "net"))
    """Definition of d_R: between front bumpers, or bumper to bumper."""
    yielding: str = field(default="unsorted", validator=one_of("unsorted", "all"))
    """Vehicles that yield to any of higher priority: those off their preferred lane, or all."""
    slow_down_mps2: float = field(default=3.0, validator=within(0.1, 20.0))
    """Deceleration of a vehicle that yields; car following brakes as hard as necessary."""
    lane_change_s: float = field(default=0.0, validator=within(0.0, 20.0))
    """Lane change duration; 0: instantaneous."""
    min_gap_m: float = field(default=1.0, validator=within(0.1, 50.0))
    """Minimum net gap; d_R between front bumpers alone would let vehicles touch."""


@frozen
class Lc2013Settings:
    """The reference method `lc2013`: SUMO's own lane changing and Krauss car following."""

    model: str = field(default="LC2013", validator=one_of("LC2013", "SL2015"))
    """SUMO's lane-changing model; with SL2015, vehicles also move within their lanes."""
    headway_s: float = field(default=0.66, validator=within(0.0, 10.0, open_low=True))
    """tau of the car-following model, bumper to bumper."""
    min_gap_m: float = field(default=0.0, validator=within(0.0, 50.0))
    """Net gap at standstill."""
    imperfection: float = field(default=0.0, validator=within(0.0, 1.0))
    """Driver imperfection (sigma): random share of the acceleration that is not used."""
    accel_mps2: float | None = field(default=None, validator=optional(within(0.1, 20.0)))
    """Acceleration; None: the vehicle's limit."""
    decel_mps2: float | None = field(default=None, validator=optional(within(0.1, 20.0)))
    """Deceleration in car following; None: the vehicle's limit, which emergencies always use."""
    strategic: float = field(default=1.0, validator=within(0.0, 100.0))
    """Weight of lane changes for the exit (lcStrategic); larger: earlier lane changes."""
    cooperative: float = field(default=1.0, validator=within(0.0, 1.0))
    """Weight of lane changes that make room for other vehicles (lcCooperative)."""
    assertive: float = field(default=1.0, validator=within(0.1, 10.0))
    """Acceptance of small gaps (lcAssertive): the required gap is divided by this."""
    lane_change_s: float = field(default=0.0, validator=within(0.0, 20.0))
    """Lane change duration; 0: instantaneous."""
    lane_changes: str = field(default="sorting", validator=one_of("sorting", "everywhere"))
    """Part of the road in which vehicles change lanes: S3, or the whole road."""


@frozen
class Runtime:
    """Execution of a run."""

    tick_s: float = field(default=0.1, validator=within(0.01, 1.0))
    tick_resend_s: float = field(default=0.05, validator=within(0.005, 10.0))
    """Interval for resending SENSE to agents that have not answered (wall-clock seconds)."""
    tick_deadline_s: float = field(default=0.3, validator=within(0.02, 60.0))
    """Time after which a tick ends; vehicles that did not answer keep their trajectories
    (wall-clock seconds)."""
    agent_silent_s: float = field(default=3.0, validator=within(0.1, 600.0))
    """Time without an answer after which ticks no longer wait for an agent, and its vehicle's
    caretaker takes charge (wall-clock seconds)."""
    agent_start_s: float = field(default=15.0, validator=within(0.1, 120.0))
    """Maximum wait at the entrance for a vehicle's agent (wall-clock seconds)."""
    announce_s: float = field(default=6.0, validator=within(0.0, 600.0))
    """Time by which announcements precede arrivals, so that agents can start (road seconds)."""
    max_pace: float = field(default=10.0, validator=within(LOWEST_PACE, HIGHEST_PACE))
    """Maximum road seconds per wall-clock second. Network and planning take wall-clock time, which
    must be short compared with the time between a plan and its start."""
    coordinators: int = field(default=3, validator=within(1, 9))
    vehicles_per_process: int = field(default=1, validator=within(1, 1000))
    max_road_s: float = field(default=100_000.0, validator=within(1.0, 1e6))
    """Road time after which an incomplete run is stopped and counts as failed."""

    def bounds(self, incarnation: int) -> Bounds:
        """Return the bounds of numbers that a process with this incarnation receives."""
        return Bounds(incarnation, self.tick_s, self.max_road_s)


@frozen
class Inflow:
    """The vehicles that enter the road in one lane."""

    volume_veh_per_h: float
    destinations: tuple[DestinationShare, ...]
    """Shares of vehicles that leave by exits; the others leave at the end of the road."""
    lane_shares: tuple[float, ...]
    """Share of these others that prefer each lane, with sum one; empty: no preferences."""
    types: tuple[TypeShare, ...]
    """Shares of types; the others are cars."""


@frozen
class Scenario:
    """Complete configuration, read by all roles."""

    schema: str = field(default=SCHEMA, validator=one_of(SCHEMA))
    seed: int = field(default=1, validator=within(0, 2**63 - 1))
    road: Road = Road()
    entrance: tuple[Entrance, ...] = ()
    """Entrances other than the start of the road."""
    exit: tuple[Exit, ...] = ()
    """Exits other than the end of the road."""
    demand: Demand = Demand()
    formation: FormationSettings = FormationSettings()
    vehicle: Vehicle = Vehicle()
    vehicle_type: tuple[VehicleType, ...] = ()
    """Types of vehicles other than cars; in the scenario of a type (`types`) all types."""
    sensing: Sensing = Sensing()
    braking: Braking = Braking()
    tracking: Tracking = Tracking()
    rule: RuleSettings = RuleSettings()
    lc2013: Lc2013Settings = Lc2013Settings()
    network: Network = Network()
    runtime: Runtime = Runtime()
    security: Security = Security()
    service: Service = Service()
    observation: Observation = Observation()
    sumo: SumoSettings = SumoSettings()

    @cached_property
    def lattice(self) -> Lattice:
        """The lattice of this scenario."""
        return Lattice(
            pitch_m=self.formation.gap_m,
            speed_mps=self.formation.speed_mps,
            lane_width_m=self.road.lane_width_m,
            lanes=self.road.lanes,
            block_columns=self.formation.block_width,
        )

    @cached_property
    def sections(self) -> tuple[LaneSection, ...]:
        """The open sections of all lanes."""
        road = self.road
        return open_sections(
            road.lanes,
            road.length_m,
            [(one.lane, one.from_m, one.to_m) for one in road.closures],
            {(lane, one.at_m): one.name for one in self.exit for lane in one.lanes},
            {(one.lane, one.at_m): one.merge_m for one in self.entrance},
        )

    def is_restricted(self, lane: int, s_m: float, vehicle_type: str) -> bool:
        """Return whether vehicles of a type may not drive in a lane at a position."""
        return any(
            one.lane == lane and one.from_m <= s_m < one.to_m and one.applies_to(vehicle_type)
            for one in self.road.restrictions
        )

    def may_leave_by(self, section: LaneSection, vehicle_type: str) -> bool:
        """Return whether vehicles of a type may drive at the end of a section."""
        return not any(
            one.lane == section.lane
            and one.from_m < section.to_m <= one.to_m
            and one.applies_to(vehicle_type)
            for one in self.road.restrictions
        )

    def goal_sections(
        self, preferred_lane: int, destination: str, vehicle_type: str
    ) -> frozenset[int]:
        """Return the numbers of the sections that serve a vehicle (`LaneSection.serves`).

        Where its type may not drive at their ends, those of other lanes to its destination; if
        there are none either, the type is ignored.
        """
        wanted = sections_for(self.sections, preferred_lane, destination)
        if not self.road.restrictions:
            return wanted
        for numbers in (wanted, sections_for(self.sections, ANY_LANE, destination)):
            permitted = frozenset(
                number
                for number in numbers
                if self.may_leave_by(self.sections[number], vehicle_type)
            )
            if permitted:
                return permitted
        return wanted

    @property
    def step_m(self) -> float:
        """Distance that a vehicle needs for one move, with the length of the longest body."""
        return self.formation.speed_mps * self.cycles_s[0] + self.longest_body_m

    @property
    def longest_formation_m(self) -> float:
        """Distance between the first and the last vehicle of the longest formation."""
        return (self.formation.max_length - 1) * self.formation.gap_m

    @cached_property
    def narrowest_lanes(self) -> int:
        """Smallest number of lanes that are open anywhere."""
        starts_m = {0.0, *(one.from_m for one in self.road.closures)}
        return min(self.open_lanes_at(s_m) for s_m in starts_m)

    def open_lanes_at(self, s_m: float) -> int:
        """Return the number of lanes that are open at a position."""
        closed = {one.lane for one in self.road.closures if one.from_m <= s_m < one.to_m}
        return self.road.lanes - len(closed)

    @property
    def ramp_share(self) -> float:
        """Vehicles from ramps for each one that enters at the start of the road."""
        from_ramps = sum(one.volume_veh_per_h for one in self.entrance)
        return from_ramps / (self.demand.volume_veh_per_lane_h * len(self.road.first_lanes))

    @property
    def vehicles_from_ramps(self) -> int:
        """Vehicles from ramps for which a full formation has room, within its maximum length."""
        formation, lanes = self.formation, self.narrowest_lanes
        expected = math.ceil(formation.max_vehicles * self.ramp_share - 1e-9)
        free = lanes if lanes > 1 else 0
        room = formation.max_columns * lanes - free - formation.max_vehicles
        return max(0, min(expected, room))

    @property
    def formation_bound_veh_per_lane_h(self) -> float:
        """Maximum volume at the start of the road at which formations have room where lanes end.

        A full formation has as many columns as its vehicles, and those expected from ramps, need,
        and one more if there are types that cannot change columns.
        """
        formation = self.formation
        most, per_column_s = formation.max_vehicles, formation.gap_m / formation.speed_mps
        columns = formation_columns(most + self.vehicles_from_ramps, self.narrowest_lanes)
        if not self.all_change_columns:
            columns = max(columns, min(columns + 1, formation.max_columns))
        if not formation.closes_by_vehicles:
            columns, most = formation.block_columns, self.block_vehicles
        return 3600.0 * most / (columns * per_column_s * len(self.road.first_lanes))

    @property
    def block_vehicles(self) -> int:
        """Maximum number of vehicles in a formation whose length is fixed."""
        lanes, formation = self.narrowest_lanes, self.formation
        if lanes == self.road.lanes:
            return formation.max_vehicles
        room = (formation.block_columns - 1) * lanes / (1.0 + self.ramp_share)
        return min(formation.max_vehicles, max(math.floor(room), 1))

    @cached_property
    def entry_m(self) -> tuple[float, ...]:
        """Where the cells of each lane are assigned and vehicles enter: at 0, or on a ramp."""
        at_m = {entrance.lane: entrance.at_m for entrance in self.entrance}
        return tuple(at_m.get(lane, 0.0) for lane in range(self.road.lanes))

    @cached_property
    def shared_exit_lanes(self) -> frozenset[int]:
        """Lanes in which a ramp follows an exit, as in most interchanges."""
        return frozenset(
            section.lane for section in self.sections if section.to_m <= self.entry_m[section.lane]
        )

    @cached_property
    def closed_to_bodies(self) -> tuple[Closure, ...]:
        """Closed parts of lanes, which no body may touch.

        Vehicles enter a ramp with their rears before it, and leave by an exit up to a tick behind.
        """
        entries = {(one.lane, one.at_m) for one in self.entrance}
        exits = {(lane, one.at_m) for one in self.exit for lane in one.lanes}
        tick_m = self.vehicle.max_speed_mps * self.runtime.tick_s
        parts = []
        for one in self.road.closures:
            from_m, to_m = one.from_m, one.to_m
            if (one.lane, from_m) in exits:
                from_m += tick_m
            if (one.lane, to_m) in entries:
                to_m -= self.longest_body_m
            if from_m < to_m:
                parts.append(Closure(one.lane, from_m, to_m))
        return tuple(parts)

    @cached_property
    def types(self) -> Mapping[str, Scenario]:
        """The scenario of each type of vehicle by its name, cars first.

        In the scenario of a type, table `vehicle` describes this type; `types` is the same.
        """
        types = self.vehicle_type
        if not types:
            return MappingProxyType({CAR: self})
        if types[0].name != CAR:
            shares = sum(one.share for one in types)
            types = (VehicleType(CAR, max(1.0 - shares, 0.0)), *types)
        # With explicit values, since types without a value would inherit another type's.
        types = tuple(one.resolved(self.vehicle) for one in types)
        return MappingProxyType(
            {
                one.name: attrs.evolve(self, vehicle=one.limits(self.vehicle), vehicle_type=types)
                for one in types
            }
        )

    @cached_property
    def drivable_moves(self) -> frozenset[Cell]:
        """The moves (columns, lanes) that are planned for the type that `vehicle` describes.

        Cars drive every move of the mode if `formation.change_columns` is set. Other types do not
        change columns if their limits along the road are lower than such a move needs
        (`column_move_limits`).
        """
        needed = self.column_move_limits
        if self.formation.change_columns and all(
            abs(getattr(self.vehicle, name)) >= limit for name, limit in needed.items()
        ):
            return self._moves_of_mode
        return frozenset(move for move in self._moves_of_mode if move[0] == 0)

    @property
    def _moves_of_mode(self) -> frozenset[Cell]:
        """All moves (columns, lanes) of the mode."""
        return frozenset(displacements(self.formation.mode)[1:])

    def moves_of(self, vehicle_type: str) -> frozenset[Cell] | None:
        """Return the moves (columns, lanes) that are planned for a type; None: all of the mode.

        There are none for a type that this scenario does not have.
        """
        own = self.types.get(vehicle_type)
        if own is None:
            return frozenset()
        return None if own.drivable_moves == self._moves_of_mode else own.drivable_moves

    @property
    def column_move_limits(self) -> dict[str, float]:
        """Limits along the road that suffice for a move by a column in the shortest T_F.

        Keys are fields of table `vehicle`, values are absolute. They are the peaks of a
        minimum-jerk move over d in T, 10 / sqrt(3) d / T^2 and 60 d / T^3, or those of cars, if
        these are lower: the trajectory of a car keeps within its limits.
        """
        d_m, move_s, cars = self.formation.gap_m, self.move_s, self.types[CAR].vehicle
        accel_mps2, jerk_mps3 = 10.0 / math.sqrt(3.0) * d_m / move_s**2, 60.0 * d_m / move_s**3
        return {
            "max_accel_mps2": min(accel_mps2, cars.max_accel_mps2),
            "min_accel_mps2": min(accel_mps2, -cars.min_accel_mps2),
            "max_jerk_mps3": min(jerk_mps3, cars.max_jerk_mps3),
        }

    @property
    def changes_columns(self) -> bool:
        """Whether the type that `vehicle` describes moves between columns."""
        return any(columns for columns, _ in self.drivable_moves)

    @property
    def all_change_columns(self) -> bool:
        """Whether all types move between columns."""
        return all(one.changes_columns for one in self.types.values())

    @property
    def longest_body_m(self) -> float:
        """Length of the longest type of vehicle."""
        return max(one.vehicle.length_m for one in self.types.values())

    @property
    def room_ahead_m(self) -> float:
        """How far ahead of its cell a vehicle that settles may be when it changes lanes.

        All others stay in their columns, so the net gap to the cell ahead is at least
        `GAP_AHEAD_M`. 0 if vehicles change columns.
        """
        formation = self.formation
        if formation.change_columns:
            return 0.0
        room_m = formation.gap_m - self.longest_body_m - GAP_AHEAD_M
        return min(max(room_m, 0.0), MAX_ROOM_AHEAD_M)

    @property
    def widest_body_m(self) -> float:
        """Width of the widest type of vehicle."""
        return max(one.vehicle.width_m for one in self.types.values())

    def entrance_of(self, lane: int) -> str:
        """Return the name of the entrance of vehicles that arrive in a lane."""
        names = {entrance.lane: entrance.name for entrance in self.entrance}
        return names.get(lane, MAIN_ENTRANCE)

    def exit_lane(self, destination: str) -> int:
        """Return the lane of an exit; `ANY_LANE` if it has several, or for `END_OF_ROAD`."""
        lanes = next((one.lanes for one in self.exit if one.name == destination), ())
        return lanes[0] if len(lanes) == 1 else ANY_LANE

    @cached_property
    def inflows(self) -> Mapping[int, Inflow]:
        """The vehicles that enter in each lane, by lane; lanes in which none enter are left out.

        A type that may not drive in some lanes at the start of the road enters in the others.
        """
        demand, first, types = self.demand, self.road.first_lanes, self._type_shares
        arriving = _normalised(demand.arrival_shares or (1.0,) * self.road.lanes, first)
        volumes = {
            lane: demand.volume_veh_per_lane_h * (len(first) * arriving[lane]) for lane in first
        }
        found = {
            lane: Inflow(volume, demand.destinations, self.lane_shares, types)
            for lane, volume in volumes.items()
            if volume > 0.0
        }
        if self.road.restrictions and found:
            found = self._permitted(found)
        every = range(self.road.lanes)
        for one in self.entrance:
            preferring = _normalised(one.lane_shares, every) if one.lane_shares else ()
            own = Inflow(
                one.volume_veh_per_h,
                one.destinations,
                preferring or self.lane_shares,
                one.vehicle_types or types,
            )
            found |= self._permitted({one.lane: own}) if self.road.restrictions else {one.lane: own}
        return MappingProxyType(dict(sorted(found.items())))

    def _permitted(self, inflows: Mapping[int, Inflow]) -> dict[int, Inflow]:
        """Return the inflows of an entrance after each type has left lanes in which it may not be.

        A type enters in its other lanes, in proportion to the volumes of these. Types
        without a lane do not enter, and there are more vehicles of the others.
        """
        shares = {one.type: one.share for one in next(iter(inflows.values())).types}
        shares[CAR] = max(0.0, 1.0 - sum(shares.values()))
        lanes_of = {
            name: [
                lane for lane in inflows if not self.is_restricted(lane, self.entry_m[lane], name)
            ]
            for name in shares
        }
        entering = sum(share for name, share in shares.items() if lanes_of[name])
        total = sum(one.volume_veh_per_h for one in inflows.values())
        found = {}
        for lane, inflow in inflows.items():
            volumes = {
                name: total
                * (share / entering)
                * inflow.volume_veh_per_h
                / sum(inflows[other].volume_veh_per_h for other in lanes_of[name])
                for name, share in shares.items()
                if share > 0.0 and lane in lanes_of[name]
            }
            volume = sum(volumes.values())
            if volume > 0.0:
                types = tuple(
                    TypeShare(name, min(own / volume, 1.0))
                    for name, own in volumes.items()
                    if name != CAR
                )
                found[lane] = attrs.evolve(inflow, volume_veh_per_h=volume, types=types)
        return found

    @property
    def _type_shares(self) -> tuple[TypeShare, ...]:
        """The shares of all types but cars."""
        return tuple(TypeShare(one.name, one.share) for one in self.vehicle_type if one.name != CAR)

    def free_flow_trip_s(self, lane: int, destination: str = END_OF_ROAD) -> float:
        """Return the time [s] at v_F from the entrance of a lane to a destination."""
        ends_m = {one.name: one.at_m for one in self.exit}
        to_m = ends_m.get(destination, self.road.length_m)
        return (to_m - self.entry_m[lane]) / self.formation.speed_mps

    @property
    def cycles_s(self) -> tuple[float, float]:
        """Shortest and longest T_F [s]; equal in the rolling operation."""
        cycle_s = self.formation.cycle_s
        if cycle_s is not None:
            return cycle_s, cycle_s
        if self.formation.rolling:
            cycle_s = ROLLING_CYCLE_S
            if self.demand.volume_veh_per_lane_h > COMFORTABLE_VOLUME_VEH_PER_LANE_H:
                cycle_s = SHORTEST_CYCLE_S
            longest_s = self._shortest_merging_s / MIN_MERGING_SLOTS
            if cycle_s > longest_s:
                steps = math.floor(longest_s / CYCLE_STEP_S + 1e-9)
                cycle_s = min(cycle_s, max(CYCLE_STEP_S * steps, self._shortest_cycle_s))
            return cycle_s, cycle_s
        return self._shortest_cycle_s, max(self._shortest_cycle_s, LONGEST_CYCLE_S)

    @property
    def _shortest_cycle_s(self) -> float:
        """Shortest T_F for which moves are likely to be possible, at least `SHORTEST_CYCLE_S`.

        A minimum-jerk move over d in T closes up with at most 15/8 d/T and accelerates with
        10 / sqrt(3) d / T^2 at most. Moves are possible if these do not exceed v_F / 2 and 1.2
        times the limit (which a trajectory within the limit can replace), in nearly all cases. For
        formations, whose plans need short slots where many steps must fit, these are
        `FORMATION_CLOSING_MPS` and 1.3 times the limit: the check of moves refuses a few scenarios
        more, and asks for a longer T_F.
        """
        if not self.formation.change_columns:
            return SHORTEST_CYCLE_S
        # T_F is the same for all types; those that are weaker drive fewer moves.
        d_m, accel_mps2 = self.formation.gap_m, self.types[CAR].vehicle.max_accel_mps2
        closing_mps, ratio = FORMATION_CLOSING_MPS, 1.3
        if self.formation.rolling:
            closing_mps, ratio = self.formation.speed_mps / 2.0, 1.2
        by_speed_s = 15.0 / 8.0 * d_m / closing_mps
        by_accel_s = math.sqrt(10.0 / math.sqrt(3.0) * d_m / (ratio * accel_mps2))
        slot_s = max(by_speed_s, by_accel_s) + self.formation.slack_s
        return max(SHORTEST_CYCLE_S, CYCLE_STEP_S * math.ceil(slot_s / CYCLE_STEP_S - 1e-9))

    @property
    def _shortest_merging_s(self) -> float:
        """Shortest time at v_F in a section that begins and ends on the road."""
        sections_m = (
            section.to_m - max(section.from_m, section.moves_from_m)
            for section in self.sections
            if section.from_m > 0.0 and section.to_m < self.road.length_m
        )
        return min(sections_m, default=math.inf) / self.formation.speed_mps

    @property
    def slots_s(self) -> tuple[float, ...]:
        """Possible values of T_F [s], ascending in steps of `CYCLE_STEP_S`."""
        shortest_s, longest_s = self.cycles_s
        count = round((longest_s - shortest_s) / CYCLE_STEP_S)
        return tuple(shortest_s + CYCLE_STEP_S * number for number in range(count + 1))

    @property
    def comfortable_cycle_s(self) -> float:
        """Shortest T_F [s] in which no move exceeds `COMFORT_MPS2`; if there is none, the longest.

        A minimum-jerk move by d in T has a peak acceleration of 10 / sqrt(3) d / T^2.
        """
        formation = self.formation
        min_s = math.sqrt(10.0 / math.sqrt(3.0) * formation.gap_m / COMFORT_MPS2)
        comfortable = [slot_s for slot_s in self.slots_s if slot_s >= min_s + formation.slack_s]
        return min(comfortable, default=self.slots_s[-1])

    @property
    def horizon_ticks(self) -> int:
        """Horizon of the tracker in ticks."""
        ticks = self.tracking.horizon_ticks
        return round(self.cycles_s[1] / self.runtime.tick_s) if ticks is None else ticks

    @property
    def free_flow_s(self) -> float:
        """Time [s] in which a vehicle passes the whole road at v_F."""
        return self.road.length_m / self.formation.speed_mps

    @property
    def move_s(self) -> float:
        """Duration of a move in the shortest T_F [s]."""
        return self.cycles_s[0] - self.formation.slack_s

    def move_ticks(self, slot_s: float) -> int:
        """Return the duration of a move [ticks] in slots of this length."""
        return round((slot_s - self.formation.slack_s) / self.runtime.tick_s)

    @property
    def move_durations(self) -> frozenset[int]:
        """Possible durations of a move in ticks."""
        return frozenset(map(self.move_ticks, self.slots_s))

    @property
    def moves_from_m(self) -> float:
        """Position [m] from which vehicles may move between cells: in S2, or the start of S3."""
        start_m, formation = self.road.sorting_start_m, self.formation
        if not (formation.rolling and formation.sort_in_s2):
            return start_m
        return min(start_m, max(self.road.s1_m, formation.speed_mps * (formation.settle_s + 4.0)))

    @property
    def draws_vehicles(self) -> bool:
        """Whether vehicles are drawn at random, and not those of a SUMO simulation."""
        return not self.sumo.config

    @property
    def lane_shares(self) -> tuple[float, ...]:
        """Share of vehicles that prefer each lane; the sum is one. Empty: no preferences."""
        if (self.road.closures or not self.draws_vehicles) and not self.demand.lane_shares:
            return ()
        lanes = range(self.road.lanes)
        return _normalised(self.demand.lane_shares or (1.0,) * len(lanes), lanes)


def _normalised(shares: Sequence[float], lanes: Collection[int]) -> tuple[float, ...]:
    """Return the shares of some lanes divided by their sum, and 0 for the others."""
    total = sum(shares[lane] for lane in lanes)
    return tuple(share / total if lane in lanes else 0.0 for lane, share in enumerate(shares))
