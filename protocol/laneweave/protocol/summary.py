"""`summary.json`: the results of one run.

The bridge writes the file when a run ends; the launcher adds the fields that only it knows.
Fields with a default are absent from summaries of earlier versions, and of runs to which they do
not apply.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any, get_args

import attrs
from attrs import field, frozen
from cattrs import Converter

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.files import overwrite, write_atomically

IN_FILE = "in_file"
"""Metadata of a field: whether the file contains it; default True."""
SUMMARY_FILE = "summary.json"
SCHEMA = "laneweave.summary/1"
HARD_BRAKE_MPS2 = 5.0
"""Deceleration beyond which vehicles are counted as braking hard."""
TTC_SHORT_S, TTC_CRITICAL_S = 3.0, 1.5
"""Times to collision below which the time that vehicles spend is summed (Hayward 1972)."""
MAX_COMFORTABLE_ACCEL_MPS2, MAX_COMFORTABLE_JERK_MPS3 = 2.0, 2.5
"""Acceleration and jerk beyond which a ride counts as uncomfortable."""


def figure(meaning: str, unit: str = "", default: object = attrs.NOTHING) -> Any:  # noqa: ANN401
    """Return a field of the summary: what it means, and its unit.

    docs/RESULT_FILES.md and the columns of a sweep's results.parquet are described with them.
    """
    return field(default=default, metadata={"meaning": meaning, "unit": unit})


def optional(meaning: str, unit: str = "") -> Any:  # noqa: ANN401 (as `attrs.field`)
    """Return a `figure` that not every summary has."""
    return figure(meaning, unit, default=None)


class Ending(Enum):
    """Reason why a run ended: the values of `RunSummary.ending`."""

    COMPLETE = "complete"
    """All demanded vehicles have left."""
    INTERRUPTED = "interrupted"
    """The run was stopped, or something failed."""
    LIMIT = "limit"
    """`max_road_s` was reached."""
    STANDSTILL = "standstill"
    """With a reference method: all vehicles have stood still for a long time."""
    UNFINISHED = "unfinished"
    """The run goes on, or its process was killed."""


@frozen(kw_only=True)
class VehicleCounts:
    """Vehicle counts."""

    demanded: int = figure("vehicles that have arrived at an entrance")
    entered: int = figure("vehicles that have entered the road")
    left: int = figure("vehicles that have left it")
    on_preferred_lane: int = figure(
        "vehicles that left by their destination, and in their preferred lane if any"
    )
    peak: int = figure("maximum number of vehicles on the road at once")
    at_destination: int | None = optional("the same as on_preferred_lane")
    left_off_lane: int | None = optional("vehicles that left elsewhere or in another lane")
    missed_exits: int | None = optional("vehicles that left by another exit than their destination")
    stopped_at_lane_end: int | None = optional(
        "vehicles that left the lattice, to stop at the end of their lane"
    )
    left_out: dict[str, int] | None = optional(
        "vehicles of a SUMO simulation that its corridor cannot serve, by reason"
    )
    left_unattended: int | None = optional("vehicles that left with a caretaker in charge")


@frozen(kw_only=True)
class TripTimes:
    """Means of the counted vehicles of one entrance or one destination [s]."""

    n: int = figure("number of counted vehicles")
    mean: float = figure("mean travel time", "s")
    delay: float = figure(
        "mean excess over the time at v_F from the entrance to the destination", "s"
    )


@frozen(kw_only=True)
class TravelTime:
    """Travel times of the counted vehicles [s]; None: no vehicle was counted."""

    mean: float | None = figure("mean travel time of the counted vehicles", "s")
    p50: float | None = figure("median", "s")
    p95: float | None = figure("95th percentile", "s")
    max: float | None = figure("longest travel time", "s")
    n: int | None = optional("number of counted vehicles")
    by_destination: dict[str, TripTimes] | None = optional(
        "by the exit by which they want to leave (end: the end of the road)"
    )
    by_entrance: dict[str, TripTimes] | None = optional("by entrance (main: the start of the road)")
    by_type: dict[str, TripTimes] | None = optional(
        "by type of vehicle (car: the scenario's table vehicle)"
    )

    @property
    def delay_s(self) -> float | None:
        """Mean excess over the time at v_F from the entrance to the destination [s]."""
        by_entrance = (self.by_entrance or {}).values()
        counted = sum(one.n for one in by_entrance)
        return sum(one.n * one.delay for one in by_entrance) / counted if counted else None


@frozen(kw_only=True)
class Safety:
    """Counts and extremes over all vehicles and ticks; None: nothing was measured."""

    overlaps: int = figure(
        "pairs of bodies that intersected at some tick; closed parts of lanes count as bodies"
    )
    sumo_collisions: int = figure("pairs of vehicles for which SUMO reported a collision")
    min_gap_m: float | None = figure(
        "minimum bumper-to-bumper gap of two vehicles whose bodies overlap laterally", "m"
    )
    min_headway_s: float | None = figure(
        "minimum of such a gap over the speed of the vehicle behind", "s"
    )
    emergency_brakes: int = figure("episodes of braking with more than 90 % of the limit")
    hard_brakes: int | None = optional(
        f"vehicles that braked with more than {HARD_BRAKE_MPS2:g} m/s2"
    )
    max_accel_mps2: float | None = figure("maximum acceleration", "m/s2")
    min_accel_mps2: float | None = figure("minimum acceleration: hardest braking", "m/s2")
    max_jerk_mps3: float | None = figure(
        "maximum of the change of acceleration between two ticks over their distance", "m/s3"
    )
    commands_refused: int | None = optional(
        "commands that motion controllers refused, as no correct agent sends them"
    )
    min_ttc_s: float | None = optional(
        "minimum time to collision of two vehicles of this system in line; absent: none approached "
        "another",
        "s",
    )
    ttc_below_3_s: float | None = optional(
        f"time that vehicles spent below {TTC_SHORT_S:g} s to collision, summed over vehicles", "s"
    )
    ttc_below_1_5_s: float | None = optional(
        f"the same below {TTC_CRITICAL_S:g} s to collision", "s"
    )
    drac_max_mps2: float | None = optional(
        "maximum deceleration rate to avoid a crash, (difference of speeds)^2 / (2 gap); 0: none "
        "approached another",
        "m/s2",
    )
    min_pet_s: float | None = optional(
        "minimum post-encroachment time: when a vehicle reaches into a lane, the time until the "
        "next one behind is where its rear was, and until it is where the rear of the next one "
        "ahead was; absent: none below 10 s",
        "s",
    )


@frozen(kw_only=True)
class Comfort:
    """Accelerations and jerks along the road, over all vehicles and ticks."""

    accel_rms_mps2: float | None = figure("root mean square of accelerations", "m/s2")
    accel_p95_mps2: float | None = figure("95th percentile of their absolute values", "m/s2")
    jerk_rms_mps3: float | None = figure("root mean square of jerks", "m/s3")
    jerk_p95_mps3: float | None = figure("95th percentile of their absolute values", "m/s3")
    uncomfortable_percent: float | None = figure(
        f"share of time with more than {MAX_COMFORTABLE_ACCEL_MPS2:g} m/s2 or "
        f"{MAX_COMFORTABLE_JERK_MPS3:g} m/s3",
        "%",
    )


@frozen(kw_only=True)
class EnergyFigures:
    """Energy and emissions per km driven, computed as if all vehicles were cars of one type."""

    model: str = figure("SUMO's emission class")
    co2_g_per_km: float = figure("carbon dioxide", "g/km")
    nox_mg_per_km: float = figure("nitrogen oxides", "mg/km")
    fuel_g_per_km: float = figure("fuel", "g/km")
    electricity_wh_per_km: float = figure("electric energy", "Wh/km")


@frozen(kw_only=True)
class PlanningMs:
    """Planning times [ms]."""

    p50: float | None = figure("median", "ms")
    p95: float | None = figure("95th percentile", "ms")
    max: float | None = figure("longest time", "ms")


@frozen(kw_only=True)
class DurationMs:
    """Durations [ms]."""

    p50: float | None = figure("median", "ms")
    p99: float | None = figure("99th percentile", "ms")


@frozen(kw_only=True)
class Planning:
    """Plan counts over all coordinators."""

    plans: int = figure("plans that were made")
    optimal: int = figure("plans whose cost is proven optimal")
    largest_formation: int = figure("maximum number of vehicles in a plan")
    by_solver: dict[str, int] | None = optional("plans by solver")
    fallbacks: int | None = optional(
        "plans that another solver made, because the chosen one found none in its share of "
        "nodes or time, or, as a plug-in, none that was valid"
    )
    solve_ms: PlanningMs = figure("time to make a plan", "ms")


@frozen(kw_only=True)
class Tracking:
    """Solve counts of agents, and counts of fallbacks."""

    solves: int = figure("ticks at which an agent tracked a reference")
    osqp_solves: int | None = optional("solves with OSQP")
    unconstrained_steps: int | None = optional("solves without OSQP (`tracking.shortcut`)")
    unusable: int = figure("solves without a usable solution")
    hold_law_ticks: int | None = optional(
        "ticks in which the hold law drove a body, without a command"
    )
    emergency_ticks: int | None = optional("ticks of emergency braking")
    missed_ticks: int | None = optional(
        "answers of agents that were missing at the deadline of their tick"
    )
    caretaker_takeovers: int | None = optional("times that a caretaker took charge of a vehicle")
    agent_takeovers: int | None = optional(
        "times that an agent took charge from a caretaker or an earlier agent"
    )
    solve_ms: DurationMs = figure("CPU time of a solve", "ms")


@frozen(kw_only=True)
class RuntimeFigures:
    """Process counts, and the speed of the run."""

    real_time_factor: float = figure("road time over wall time")
    wall_s: float = figure("wall time of the run", "s")
    processes: int | None = figure("maximum number of processes at once; null: unknown")
    vehicles_per_process: int = figure("vehicles per agent process")
    tick_ms: DurationMs = figure("wall time of a tick", "ms")


@frozen(kw_only=True)
class Messages:
    """Message counts over all processes."""

    published: int = figure("messages published by all processes")
    dropped_by_faults: int = figure("messages dropped by injected faults")
    rejected: int | None = optional("malformed messages that were received")
    sidelink: int | None = optional(
        "messages between vehicles, for each receiver; null: without a radio"
    )
    sidelink_lost: int | None = optional("those that the radio lost")
    cellular: int | None = optional(
        "messages between vehicles and coordinators, for each receiver; null: without a radio"
    )
    cellular_lost: int | None = optional("those that the radio lost")


@frozen(kw_only=True)
class LeaderChanges:
    """Leadership changes."""

    leader_changes: int = figure("times that another candidate became leader")
    recovery_s: list[float] = figure(
        "periods without a leader; with injected faults: from each fault of a leader until "
        "another candidate led",
        "s",
    )
    plan_recovery_s: list[float] | None = optional(
        "times from each leader fault until the next plan was in force", "s"
    )


@frozen(kw_only=True)
class ObstacleFigures:
    """A part of a lane that was closed for a time."""

    cause: str = figure(
        "breakdown: of a vehicle; closed: by an event of the road or an operator; passing: a "
        "vehicle of another system"
    )
    lane: int = figure("lane; 0 is the rightmost")
    from_m: float = figure("beginning of the part, or where a passing vehicle entered", "m")
    to_m: float = figure("end of the part", "m")
    vehicle: str = figure("vehicle that broke down or passed; empty: none")
    since_s: float = figure("road time at which the part was closed", "s")
    opened_s: float | None = optional("road time from which it was open again", "s")
    stopped: int = figure(
        "vehicles that left the lattice meanwhile, in its lane and before its end", default=0
    )
    waited_s: float = figure("sum of the times until they were in cells again", "s", default=0.0)
    lowest_speed_mps: float | None = optional("lowest speed of a passing vehicle", "m/s")


@frozen(kw_only=True)
class RunSummary:
    """The content of `summary.json`."""

    schema: str = figure("name and number of the schema")
    method: str = figure("value of laneweave run --method")
    seed: int = figure("seed of the scenario")
    volume_veh_per_lane_h: float = figure("demand per lane", "veh/(lane h)")
    lanes: int = figure("number of lanes")
    road_m: float = figure("length of the road", "m")
    simulated_s: float = figure("road time at the end", "s")
    vehicles: VehicleCounts
    travel_time_s: TravelTime
    throughput_veh_per_lane_h: float | None = figure(
        "vehicles that leave between the first and the last counted one; null: undefined",
        "veh/(lane h)",
    )
    safety: Safety
    comfort: Comfort | None = optional("comfort of passengers")
    energy: dict[str, EnergyFigures] | None = optional(
        "by type of car (petrol, diesel, electric); absent without the package eclipse-sumo, or "
        "if the models failed"
    )
    ending: str | None = optional(
        "complete: all demanded vehicles have left; limit: runtime.max_road_s was reached; "
        "standstill: all vehicles stood still (reference methods); "
        "interrupted: the run was stopped, or something failed; unfinished: the run goes on, or "
        "the process that recorded it was killed"
    )
    recorded_until_s: float | None = optional(
        "road time until which the run is recorded, if the disk failed", "s"
    )
    obstacles: list[ObstacleFigures] | None = optional("parts of lanes closed for a time")
    planning: Planning
    tracking: Tracking
    runtime: RuntimeFigures
    messages: Messages
    failover: LeaderChanges
    faults: dict[str, Any] | None = optional(
        "faults that were `injected`, `partition_methods`, and perhaps `why_no_namespaces`; absent "
        "without a fault file"
    )
    plug_ins: list[str] | None = optional(
        "name and version of the distributions whose plug-ins made plans or drove vehicles"
    )
    folder: Path | None = field(default=None, eq=False, metadata={IN_FILE: False})
    """Folder of the run, which is not part of the file."""

    def not_left(self, *, of_sumo: bool) -> int:
        """Return how many vehicles have not left the road, though they should have.

        Args:
            of_sumo: whether vehicles come from a SUMO simulation. Then a complete run may leave
                some outside: SUMO drives them elsewhere, or their exits are full.
        """
        outside_allowed = of_sumo and self.ending == Ending.COMPLETE.value
        vehicles = self.vehicles
        expected = vehicles.entered if outside_allowed else vehicles.demanded
        return max(0, expected - vehicles.left)

    @classmethod
    def from_json(cls, data: object) -> RunSummary:
        """Read a summary from a JSON object.

        Raises:
            BadInputError: the object is not a summary.
        """
        try:
            return _CONVERTER.structure(data, cls)
        except Exception as error:
            raise BadInputError(SUMMARY_FILE, type(data).__name__, "a run's summary") from error

    def to_json(self) -> dict[str, Any]:
        """Return the summary as a JSON object."""
        return attrs.asdict(self, filter=_is_written)

    @property
    def preferred_percent(self) -> float | None:
        """Percentage of the departed vehicles that left in their preferred lane."""
        left = self.vehicles.left
        return 100.0 * self.vehicles.on_preferred_lane / left if left else None


def described(kind: type = RunSummary, prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield (path, unit, meaning) of each field that contains a value, parts separated by dots.

    `*` in a path stands for the name of an entrance, a destination, or a type of vehicle or car.
    """
    for one in attrs.fields(attrs.resolve_types(kind)):
        if not one.metadata.get(IN_FILE, True):
            continue
        unit, meaning = one.metadata.get("unit", ""), one.metadata.get("meaning", "")
        inner = [part for part in (one.type, *get_args(one.type)) if isinstance(part, type)]
        tables = [part for part in inner if attrs.has(part)]
        mapped = [part for own in get_args(one.type) for part in get_args(own) if attrs.has(part)]
        if tables or mapped:
            outer = f"{prefix}{one.name}." + ("" if tables else "*.")
            for path, own_unit, own in described((tables or mapped)[0], outer):
                yield path, own_unit, f"{meaning}: {own}" if meaning else own
        else:
            yield f"{prefix}{one.name}", unit, meaning


def read_summary(folder: Path) -> RunSummary | None:
    """Return the summary in a run's folder; None if it is missing or invalid."""
    try:
        data = json.loads((folder / SUMMARY_FILE).read_text(encoding="utf-8"))
        return attrs.evolve(RunSummary.from_json(data), folder=folder)
    except (OSError, ValueError):
        return None


def write_summary(folder: Path, summary: RunSummary) -> None:
    """Write `summary.json` atomically; on a full disk, in place of an earlier one of the run.

    Raises:
        OSError: there is no room for it.
    """
    text = json.dumps(summary.to_json(), indent=2, allow_nan=False) + "\n"
    path = folder / SUMMARY_FILE
    try:
        write_atomically(path, text)
    except OSError:
        # The blocks of an earlier summary are usually enough for this one.
        with path.open("rb+", buffering=0) as file:
            overwrite(file, 0, text.encode())


def _is_written(one: attrs.Attribute[Any], value: object) -> bool:
    if not one.metadata.get(IN_FILE, True):
        return False
    return one.default is attrs.NOTHING or value is not None


_CONVERTER = Converter(detailed_validation=False)
