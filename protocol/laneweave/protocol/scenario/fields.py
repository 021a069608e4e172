"""The scenario: one TOML file for world and deployment, read by every role.

Every field has a unit in its name, a default (the paper's value, Table "Simulation parameters",
where the paper gives one) and a checked range. `config.loading` reads the file and checks the
fields against each other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import attrs
from attrs import field, frozen
from attrs.validators import optional

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import one_of, within
from laneweave.protocol.lattice import Lattice
from laneweave.protocol.scenario.deployment_fields import Network, Observation, Security, Service
from laneweave.protocol.wire.events import STREAM_PLANNED

SCHEMA = "laneweave.scenario/1"

BASE_CONFLICTS = ("node", "edge", "special-1")
SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 4.0, 7.0
"""Range of T_F where `formation.cycle_s` leaves it open: from the paper's value on."""
COMFORT_MPS2 = 3.0
"""Accelerations up to this are comfortable, along and across."""
ROLLING_CYCLE_S = 6.0
COMFORTABLE_VOLUME_VEH_PER_LANE_H = 2000.0
"""Up to this volume T_F of the rolling operation is `ROLLING_CYCLE_S`, which is comfortable. Denser
traffic needs more steps on the same road: at 2400 one vehicle in a hundred misses its lane with
6 s, none in a thousand with 4 s (`benchmarks/stream.py`)."""
CYCLE_STEP_S = 0.2
"""Step between values of T_F: few values mean few trajectories to plan."""
SLACK_S = 0.2
"""Part of T_F in which nothing moves, unless `formation.move_s` says otherwise."""

PAPERS_FORMATIONS: Mapping[str, object] = MappingProxyType(
    {"entry": "interlaced", "close": "columns", "cycle_s": 4.0}
)
"""Values of the table `formation` that `operation = "paper"` stands for in files, recordings and
options."""

SOLVERS: Final = ("tappa", "branching")
"""`tappa`: the paper's algorithm. `branching`: branch and bound, for large formations."""
DEFAULT_SOLVER: Final = "tappa"
ROLLING_SOLVER: Final = "rolling"
"""Planner of the rolling operation, where plans are counted by solver."""
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


def solver_of_event(kind: str, data: Mapping[str, Any]) -> str | None:
    """Return the solver that an event reports; None if it reports none."""
    if kind == STREAM_PLANNED:
        return ROLLING_SOLVER
    solver = data.get("solver")
    return str(solver) if solver in SOLVERS else None


def _conflict_kinds(_: object, attribute: attrs.Attribute[Any], value: Sequence[str]) -> None:
    for kind in value:
        if kind not in CONFLICT_KINDS:
            raise BadInputError(attribute.name, kind, "any of " + ", ".join(CONFLICT_KINDS))


@frozen
class Road:
    """The road: segments S1 (entry), S2 (driving), S3 (lane sorting); paper, Section 5.2.1."""

    lanes: int = field(default=3, validator=within(1, 8))
    lane_width_m: float = field(default=3.5, validator=within(2.0, 10.0))
    s1_m: float = field(default=50.0, validator=within(0.0, 20_000.0))
    s2_m: float = field(default=350.0, validator=within(0.0, 20_000.0))
    s3_m: float = field(default=600.0, validator=within(0.0, 20_000.0, open_low=True))

    @property
    def length_m(self) -> float:
        """Whole length of the road."""
        return self.s1_m + self.s2_m + self.s3_m

    @property
    def sorting_start_m(self) -> float:
        """Where S3 begins: no lane change before it."""
        return self.s1_m + self.s2_m


@frozen
class Demand:
    """Random arrivals: per lane, headway = minimum + exponential, mean 3600 / volume."""

    volume_veh_per_lane_h: float = field(default=1000.0, validator=within(0, 3600, open_low=True))
    duration_s: float = field(default=300.0, validator=within(0, 86_400, open_low=True))
    min_headway_s: float = field(default=1.0, validator=within(0.0, 60.0))
    lane_shares: tuple[float, ...] = ()
    """Share of vehicles that prefer each lane; empty: equal shares."""


@frozen
class DrivingStructure:
    """A geometric structure in which formations drive before they sort (paper, Section 2.2)."""

    from_m: float = field(validator=within(0.0, 60_000.0))
    """Formations change to it when their rear has passed this position."""
    structure: str = field(validator=one_of("parallel", "interlaced"))
    lanes: tuple[int, ...] = ()
    """Lanes that it uses; empty: all lanes."""


@frozen
class FormationSettings:
    """Formation control parameters d_F, T_F, v_F and settings of the planner."""

    operation: str = field(default="formations", validator=one_of("formations", "rolling"))
    """`formations`: closed formations, each sorted by one plan (the paper's operation).
    `rolling`: no formations; the whole stream is replanned in each slot."""
    entry: str = field(default="free", validator=one_of("free", "interlaced"))
    """Formations: the cells that vehicles may enter, all or those of the interlaced structure."""
    close: str = field(default="vehicles", validator=one_of("vehicles", "columns"))
    """Formations: `vehicles`: a formation ends at `max_vehicles` vehicles or `max_columns` columns;
    `columns`: each formation has `block_columns` columns, as in the paper."""
    gap_m: float = field(default=15.0, validator=within(1.0, 200.0))
    """d_F, the column pitch."""
    cycle_s: float | None = field(default=None, validator=optional(within(0.5, 60.0)))
    """T_F, the time slot of a step. None: formations take 4 to 7 s, as long as their road allows;
    the rolling operation chooses by volume (`Scenario.cycles_s`)."""
    move_s: float | None = field(default=None, validator=optional(within(0.5, 60.0)))
    """Time that a move takes within its slot; the rest is slack for lost messages. None: 0.2 s
    less than T_F."""
    speed_mps: float = field(default=15.0, validator=within(1.0, 60.0))
    """v_F, the speed of the lattice."""
    settle_s: float = field(default=10.0, validator=within(1.0, 60.0))
    """Time from the entry until a vehicle is in its cell."""
    sort_in_s2: bool = False
    """Rolling operation: lanes are changed in S2, too, as soon as vehicles have settled."""
    reward_drift: bool = False
    """Rolling operation: moving ahead of v_F counts as a gain where it costs no other vehicle."""
    block_columns: int = field(default=4, validator=within(1, 24))
    """Columns of a formation where `close` is `columns`; the interlaced structure uses half of
    its cells."""
    max_columns: int = field(default=7, validator=within(1, 24))
    """Maximum length of a formation where `close` is `vehicles`."""
    max_vehicles: int = field(default=6, validator=within(1, 36))
    """Maximum size of a formation (paper: six)."""
    max_joined: int = field(default=1, validator=within(1, 4))
    """Maximum number of neighbouring formations that one ballot may join."""
    join: str = field(default="needed", validator=one_of("needed", "room"))
    """When neighbouring formations join: `needed`: when one alone lacks room for sorting; `room`:
    also when the vehicles of both fit into one formation, `max_vehicles`."""
    structures: tuple[DrivingStructure, ...] = ()
    """Structures that formations take on one after the other before they sort in S3; empty: they
    stay in the cells in which they entered."""
    mode: int = field(default=1, validator=one_of(1, 2))
    """Relative motion mode."""
    conflicts: tuple[str, ...] = field(default=(), validator=_conflict_kinds)
    """Conflict kinds the planner avoids; empty: those of the mode, and closing."""
    weight_straight: int = field(default=1, validator=one_of(0, 1))
    """l_s of the formation relative distance."""
    weight_oblique: int | None = field(default=None, validator=one_of(None, 0, 1, 2))
    """l_o of the formation relative distance; none: the number of steps of an oblique edge."""
    solver: str = field(default=DEFAULT_SOLVER, validator=one_of(*SOLVERS))
    """Solver of formations, and of requests to the planning service that name none."""
    planning_deadline_s: float | None = field(
        default=None, validator=optional(within(0.01, 3600.0))
    )
    """Upper bound on planning time; none: the time until the first move could begin, 1 to 15 s. On
    most machines `max_nodes` is reached first."""
    max_nodes: int = field(default=20_000, validator=within(1, 100_000_000))
    """Maximum number of search nodes per plan: results do not depend on the machine's speed."""

    @property
    def rolling(self) -> bool:
        """Whether the operation is the rolling one."""
        return self.operation == "rolling"

    @property
    def interlaced(self) -> bool:
        """Whether only the cells of the interlaced structure may be entered."""
        return not self.rolling and self.entry == "interlaced"

    @property
    def closes_by_vehicles(self) -> bool:
        """Whether the lengths of formations follow the traffic."""
        return not self.rolling and self.close == "vehicles"

    @property
    def block_width(self) -> int:
        """Columns of a block, the unit of which formations own one or several."""
        return 1 if self.closes_by_vehicles else self.block_columns

    @property
    def max_length(self) -> int:
        """Maximum number of columns of a formation."""
        return self.max_columns if self.closes_by_vehicles else self.block_columns

    @property
    def slack_s(self) -> float:
        """Part of T_F in which nothing moves."""
        if self.cycle_s is None or self.move_s is None:
            return SLACK_S
        return self.cycle_s - self.move_s

    @property
    def entry_spacing_s(self) -> float:
        """Time between two cells of a lane that may be entered."""
        return (2.0 if self.interlaced else 1.0) * self.gap_m / self.speed_mps

    @property
    def bound_veh_per_lane_h(self) -> float:
        """Maximum number of vehicles per lane and hour: one for each cell that may be entered.

        V_u = 3600 v_F / (2 d_F) with interlaced entry (paper, Section 5.2.3), twice as many
        where every cell may be entered.
        """
        return 3600.0 / self.entry_spacing_s

    @property
    def entry_spread_s(self) -> float:
        """Maximum time between a vehicle and its cell as they pass the start of the road.

        Half of the time between two cells, so that a vehicle waits only if it is too close behind
        another one. In formations half as much again: vehicles catch up with cells that stayed
        empty, and queues end sooner.
        """
        return (0.5 if self.rolling else 0.75) * self.entry_spacing_s

    @property
    def oblique_steps(self) -> int:
        """Steps that an oblique edge takes: the largest l_o that still is a lower bound."""
        return 2 if self.mode == 1 else 1

    @property
    def conflict_kinds(self) -> tuple[str, ...]:
        """The conflict kinds in force."""
        if self.conflicts:
            return self.conflicts
        return (*(BASE_CONFLICTS if self.mode == 1 else ("geometric",)), "closing")

    @property
    def executable(self) -> bool:
        """Whether moves of one step have disjoint footprints, as plans without timetable need."""
        kinds = set(self.conflict_kinds)
        return "geometric" in kinds or (self.mode == 1 and set(BASE_CONFLICTS) <= kinds)


@frozen
class Vehicle:
    """Size and limits of every vehicle."""

    length_m: float = field(default=5.0, validator=within(1.0, 30.0))
    width_m: float = field(default=1.8, validator=within(0.5, 4.0))
    max_speed_mps: float = field(default=25.0, validator=within(1.0, 80.0))
    min_accel_mps2: float = field(default=-10.0, validator=within(-20.0, -0.1))
    max_accel_mps2: float = field(default=5.0, validator=within(0.1, 20.0))
    max_jerk_mps3: float = field(default=15.0, validator=within(0.1, 100.0))
    max_lateral_accel_mps2: float = field(default=3.0, validator=within(0.1, 20.0))
    max_lateral_jerk_mps3: float = field(default=8.0, validator=within(0.1, 100.0))
    max_slip_ratio: float = field(default=0.25, validator=within(0.01, 1.0))
    """Lateral speed is at most this share of the forward speed: no sliding sideways."""
    actuator_lag_s: float = field(default=0.2, validator=within(0.0, 2.0))
    """The body's acceleration follows its set-point as a first-order lag of this time constant."""
    lateral_actuator_lag_s: float = field(default=0.1, validator=within(0.0, 2.0))


@frozen
class Sensing:
    """Standard deviations of measurement errors, which are drawn anew at each tick."""

    position_noise_m: float = field(default=0.05, validator=within(0.0, 5.0))
    lateral_noise_m: float = field(default=0.02, validator=within(0.0, 1.0))
    speed_noise_mps: float = field(default=0.02, validator=within(0.0, 2.0))
    """Of its own speed, along and across."""
    accel_noise_mps2: float = field(default=0.05, validator=within(0.0, 2.0))
    """Of its own acceleration, along and across."""
    gap_noise_m: float = field(default=0.05, validator=within(0.0, 2.0))
    """Of the gap to another vehicle."""
    other_speed_noise_mps: float = field(default=0.03, validator=within(0.0, 2.0))
    other_accel_noise_mps2: float = field(default=0.2, validator=within(0.0, 5.0))


@frozen
class Braking:
    """Assumptions of the emergency brake about the vehicle ahead and its own vehicle.

    Its own braking is `vehicle.min_accel_mps2`, through `vehicle.actuator_lag_s`.
    """

    lead_brake_mps2: float = field(default=10.0, validator=within(0.1, 30.0))
    """Hardest braking of the vehicle ahead."""
    lead_lag_s: float = field(default=0.2, validator=within(0.0, 2.0))
    """Minimum time constant of the first-order lag of its brakes."""
    reaction_s: float = field(default=0.1, validator=within(0.01, 5.0))
    """Time from a measurement to the set-point that follows from the next one: one tick, and whole
    ticks for delays of sensors and brakes (none in this plant)."""
    margin_m: float = field(default=0.3, validator=within(0.0, 10.0))
    """Net gap left when both stand still; measurement errors reduce it."""


@frozen
class Tracking:
    """The tracking controller of the lower level."""

    horizon_ticks: int | None = field(default=None, validator=optional(within(10, 200)))
    """Ticks that the tracker looks ahead; None: the longest T_F."""
    min_gap_m: float = field(default=3.0, validator=within(0.0, 100.0))
    """The tracker leaves its reference to keep this net gap to the vehicle ahead."""
    always_solve: bool = False
    """Solve the quadratic program with OSQP in every tick, also where its solution without the
    inequalities is known to satisfy them all."""


@frozen
class RuleSettings:
    """The rule-based reference method (paper, Section 5.2.2), as decision 20 reads it."""

    standstill_gap_m: float = field(default=5.0, validator=within(0.0, 100.0))
    """d_0 of the gap d_R = d_0 + v tau; the paper's table calls it d_R."""
    headway_s: float = field(default=0.66, validator=within(0.0, 10.0))
    """tau of the same."""
    stop_distance_m: float = field(default=150.0, validator=within(1.0, 20_000.0))
    """d_stop: a vehicle that yields this near to the end stops; d_end in the paper's table."""
    gap: str = field(default="front-to-front", validator=one_of("front-to-front", "net"))
    """What d_R is measured between: front bumpers, or bumper to bumper."""
    yielding: str = field(default="unsorted", validator=one_of("unsorted", "all"))
    """Vehicles that slow down for one of higher priority."""
    slow_down_mps2: float = field(default=3.0, validator=within(0.1, 20.0))
    """Braking of a vehicle that yields; behind another vehicle it brakes as hard as needed."""
    lane_change_s: float = field(default=0.0, validator=within(0.0, 20.0))
    """Time that a lane change takes; 0: none."""
    min_gap_m: float = field(default=1.0, validator=within(0.1, 50.0))
    """Minimum net gap: d_R alone, front to front, would let bumpers touch."""


@frozen
class Lc2013Settings:
    """The reference method that is SUMO's own: lane changing LC2013, car following of Krauss."""

    headway_s: float = field(default=0.66, validator=within(0.0, 10.0, open_low=True))
    """tau of the car following, from bumper to bumper."""
    min_gap_m: float = field(default=0.0, validator=within(0.0, 50.0))
    """Net gap at standstill."""
    lane_change_s: float = field(default=0.0, validator=within(0.0, 20.0))
    """Time that a lane change takes; 0: none."""
    lane_changes: str = field(default="sorting", validator=one_of("sorting", "everywhere"))
    """Where lanes are changed: in S3 only, or on the whole road."""


@frozen
class Runtime:
    """How a run is executed."""

    tick_s: float = field(default=0.1, validator=within(0.01, 1.0))
    tick_resend_s: float = field(default=0.05, validator=within(0.005, 10.0))
    """Interval at which a tick is resent to agents that have not answered (wall-clock seconds)."""
    tick_deadline_s: float = field(default=0.3, validator=within(0.02, 60.0))
    """A tick proceeds after this time; vehicles without an answer continue their trajectories
    (wall-clock seconds)."""
    agent_silent_s: float = field(default=3.0, validator=within(0.1, 600.0))
    """After this time without an answer ticks no longer wait for an agent, and its vehicle's
    caretaker takes charge (wall-clock seconds)."""
    agent_start_s: float = field(default=15.0, validator=within(0.1, 120.0))
    """Maximum wait at the entrance for a vehicle's agent (wall-clock seconds)."""
    announce_s: float = field(default=6.0, validator=within(0.0, 600.0))
    """Arrivals are announced this long ahead, so that their agents are up in time (road s)."""
    max_pace: float = field(default=10.0, validator=within(0.01, 1000.0))
    """Maximum road seconds per second: the wall-clock time of network and planning must stay short
    compared with the time between a plan and its start."""
    coordinators: int = field(default=3, validator=within(1, 9))
    vehicles_per_process: int = field(default=1, validator=within(1, 1000))
    max_road_s: float = field(default=100_000.0, validator=within(1.0, 1e6))
    """A run that exceeds this road time is ended and counts as failed."""


@frozen
class Scenario:
    """Complete configuration, read by all roles."""

    schema: str = field(default=SCHEMA, validator=one_of(SCHEMA))
    seed: int = field(default=1, validator=within(0, 2**63 - 1))
    road: Road = Road()
    demand: Demand = Demand()
    formation: FormationSettings = FormationSettings()
    vehicle: Vehicle = Vehicle()
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

    @property
    def lattice(self) -> Lattice:
        """The moving lattice of this scenario."""
        return Lattice(
            pitch_m=self.formation.gap_m,
            speed_mps=self.formation.speed_mps,
            lane_width_m=self.road.lane_width_m,
            lanes=self.road.lanes,
            block_columns=self.formation.block_width,
        )

    @property
    def cycles_s(self) -> tuple[float, float]:
        """Shortest and longest T_F [s]; the same in the rolling operation, which has one slot."""
        cycle_s = self.formation.cycle_s
        if cycle_s is not None:
            return cycle_s, cycle_s
        if self.formation.rolling:
            dense = self.demand.volume_veh_per_lane_h > COMFORTABLE_VOLUME_VEH_PER_LANE_H
            cycle_s = SHORTEST_CYCLE_S if dense else ROLLING_CYCLE_S
            return cycle_s, cycle_s
        return SHORTEST_CYCLE_S, LONGEST_CYCLE_S

    @property
    def slots_s(self) -> tuple[float, ...]:
        """T_F that plans may have [s], ascending: every `CYCLE_STEP_S` from shortest to longest."""
        shortest_s, longest_s = self.cycles_s
        count = round((longest_s - shortest_s) / CYCLE_STEP_S)
        return tuple(shortest_s + CYCLE_STEP_S * number for number in range(count + 1))

    @property
    def comfortable_cycle_s(self) -> float:
        """Shortest T_F that plans may have in which no move needs more than `COMFORT_MPS2` [s].

        A minimum-jerk move by d in T needs an acceleration of 10 / sqrt(3) d / T^2. If there is
        none, the longest.
        """
        formation = self.formation
        min_s = math.sqrt(10.0 / math.sqrt(3.0) * formation.gap_m / COMFORT_MPS2)
        comfortable = [slot_s for slot_s in self.slots_s if slot_s >= min_s + formation.slack_s]
        return min(comfortable, default=self.slots_s[-1])

    @property
    def horizon_ticks(self) -> int:
        """Ticks that the tracker looks ahead."""
        ticks = self.tracking.horizon_ticks
        return round(self.cycles_s[1] / self.runtime.tick_s) if ticks is None else ticks

    @property
    def move_s(self) -> float:
        """Time that a move takes in the shortest T_F [s]."""
        return self.cycles_s[0] - self.formation.slack_s

    def move_ticks(self, slot_s: float) -> int:
        """Return how many ticks a move takes in slots of this length."""
        return round((slot_s - self.formation.slack_s) / self.runtime.tick_s)

    @property
    def move_durations(self) -> frozenset[int]:
        """Ticks that a move may take: in each T_F that plans may have."""
        return frozenset(map(self.move_ticks, self.slots_s))

    @property
    def moves_from_m(self) -> float:
        """Position from which bodies may move from cell to cell: S3, or S2 if that is used."""
        start_m, formation = self.road.sorting_start_m, self.formation
        if not (formation.rolling and formation.sort_in_s2):
            return start_m
        return min(start_m, max(self.road.s1_m, formation.speed_mps * (formation.settle_s + 4.0)))

    @property
    def lane_shares(self) -> tuple[float, ...]:
        """Share of vehicles that prefer each lane, one number per lane, summing to one."""
        shares = self.demand.lane_shares or (1.0,) * self.road.lanes
        total = sum(shares)
        return tuple(share / total for share in shares)
