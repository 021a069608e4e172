"""Tables of a scenario file about the reference methods."""

from __future__ import annotations

from attrs import field, frozen

from laneweave.protocol.field_validators import one_of, within, within_or_none


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
