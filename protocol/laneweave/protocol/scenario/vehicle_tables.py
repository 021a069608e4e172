"""Tables of a scenario file about vehicles, their sensors and brakes, and reference methods."""

from __future__ import annotations

import math

import attrs
from attrs import field, frozen

from laneweave.protocol.field_validators import key_part, one_of, within, within_or_none

PEAK_ACCEL = 10.0 / math.sqrt(3.0)
"""Peak acceleration of a minimum-jerk move by d in T, in d / T^2."""
PEAK_JERK = 60.0
"""Peak jerk of a minimum-jerk move by d in T, in d / T^3."""
MAX_HORIZON_TICKS = 200
"""Maximum horizon of the tracker."""


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
class VehicleTypeSettings:
    """A type of vehicle other than cars; for values that are not set, those of cars apply."""

    name: str = field(validator=key_part)
    share: float = field(validator=within(0.0, 1.0))
    """Share of vehicles of this type, at entrances without shares of their own."""
    length_m: float | None = field(default=None, validator=within_or_none(1.0, 30.0))
    width_m: float | None = field(default=None, validator=within_or_none(0.5, 4.0))
    min_accel_mps2: float | None = field(default=None, validator=within_or_none(-20.0, -0.1))
    max_accel_mps2: float | None = field(default=None, validator=within_or_none(0.1, 20.0))
    """A move by a column that needs more is not planned for the type."""
    max_jerk_mps3: float | None = field(default=None, validator=within_or_none(0.1, 100.0))
    max_lateral_accel_mps2: float | None = field(default=None, validator=within_or_none(0.1, 20.0))
    max_lateral_jerk_mps3: float | None = field(default=None, validator=within_or_none(0.1, 100.0))

    def limits(self, cars: Vehicle) -> Vehicle:
        """Return size and limits of the type, given those of cars."""
        own = attrs.asdict(self, filter=lambda _, value: value is not None)
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

    horizon_ticks: int | None = field(default=None, validator=within_or_none(10, MAX_HORIZON_TICKS))
    """Horizon of the tracker; None: the longest T_F."""
    min_gap_m: float = field(default=3.0, validator=within(0.0, 100.0))
    """Minimum net gap to the vehicle ahead; takes precedence over the reference."""
    shortcut: bool = False
    """Use the unconstrained solution of the quadratic program without OSQP where it satisfies all
    constraints: the same jerks (within 1e-3 m/s3) in less time, for sweeps."""


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
    speed_factor: float = field(default=1.0, validator=within(0.5, 2.0))
    """Desired speed, divided by v_F."""
    headway_s: float = field(default=0.66, validator=within(0.0, 10.0, open_low=True))
    """tau of the car-following model, bumper to bumper."""
    min_gap_m: float = field(default=0.0, validator=within(0.0, 50.0))
    """Net gap at standstill."""
    imperfection: float = field(default=0.0, validator=within(0.0, 1.0))
    """Driver imperfection (sigma): random share of the acceleration that is not used."""
    accel_mps2: float | None = field(default=None, validator=within_or_none(0.1, 20.0))
    """Acceleration; None: the vehicle's limit."""
    decel_mps2: float | None = field(default=None, validator=within_or_none(0.1, 20.0))
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
