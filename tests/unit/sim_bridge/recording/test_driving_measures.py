"""Measures of safety and comfort equal those of a plain computation, row by row."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest
from attrs import evolve, frozen

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.sim_bridge.recording.driving_measures import DrivingMeasures, Rows

SCENARIO = Scenario()
LANE_M, TICK_S = SCENARIO.road.lane_width_m, SCENARIO.runtime.tick_s
CAR = evolve(SCENARIO.vehicle, length_m=5.0, width_m=1.8, min_accel_mps2=-10.0)
TRUCK = evolve(CAR, length_m=12.0, width_m=2.5, min_accel_mps2=-6.0)


@frozen
class Row:
    """A vehicle at a tick."""

    s_m: float
    y_m: float
    speed_mps: float = 15.0
    accel_mps2: float = 0.0


Tick = Mapping[str, Row]


def measured(
    ticks: Sequence[Tick], limits: Mapping[str, Vehicle] | None = None, batch: int = 10**6
) -> DrivingMeasures:
    """Return the measures of ticks, added in batches of at most `batch` ticks."""
    measures = DrivingMeasures(evolve(SCENARIO, vehicle=CAR))
    for name, own in (limits or {}).items():
        measures.enter(name, own)
    for first in range(0, len(ticks), batch):
        rows = [
            (name, TICK_S * tick, row.s_m, row.y_m, row.speed_mps, row.accel_mps2)
            for tick in range(first, min(first + batch, len(ticks)))
            for name, row in ticks[tick].items()
        ]
        if rows:
            names, *columns = zip(*rows, strict=True)
            measures.add(Rows.of(pa.array(names), *map(np.array, columns)))
    return measures


def lane_y_m(lane: float) -> float:
    """Return the middle of a lane."""
    return (lane + 0.5) * LANE_M


# --- a plain computation -------------------------------------------------------------------------


def touched(row: Row, own: Vehicle) -> set[int]:
    """Return the lanes that a body touches."""
    low_m, high_m = row.y_m - own.width_m / 2 + 1e-9, row.y_m + own.width_m / 2 - 1e-9
    return set(range(math.floor(low_m / LANE_M), math.floor(high_m / LANE_M) + 1))


def approaches(tick: Tick, limits: Mapping[str, Vehicle]) -> Iterator[tuple[float, float]]:
    """Yield (gap, closing speed) of each vehicle that approaches the next one in line."""
    for name, row in tick.items():
        own = limits.get(name, CAR)
        ahead = [
            (other.s_m, other.s_m - limits.get(key, CAR).length_m, other.speed_mps)
            for key, other in tick.items()
            if key != name
            and 0.0 <= other.s_m - row.s_m <= 100.0
            and abs(other.y_m - row.y_m) < (own.width_m + limits.get(key, CAR).width_m) / 2 - 1e-9
        ]
        if ahead:
            _, rear_m, speed_mps = min(ahead)
            if row.speed_mps > speed_mps:
                yield max(rear_m - row.s_m, 0.0), row.speed_mps - speed_mps


def encroachments(ticks: Sequence[Tick], limits: Mapping[str, Vehicle]) -> Iterator[float]:
    """Yield the post-encroachment times of all lane changes."""
    for number in range(1, len(ticks)):
        for name, row in ticks[number].items():
            before = ticks[number - 1].get(name)
            if before is None:
                continue
            own = limits.get(name, CAR)
            for lane in touched(row, own) - touched(before, own):
                beside = {
                    key: other
                    for key, other in ticks[number].items()
                    if key != name and lane in touched(other, limits.get(key, CAR))
                }
                behind = [(one.s_m, key) for key, one in beside.items() if one.s_m <= row.s_m]
                rears_m = [
                    one.s_m - limits.get(key, CAR).length_m
                    for key, one in beside.items()
                    if one.s_m > row.s_m
                ]
                if behind:
                    yield arrival_s(
                        ticks, number, max(behind)[1], lane, row.s_m - own.length_m, limits
                    )
                if rears_m:
                    yield arrival_s(ticks, number, name, lane, min(rears_m), limits)


def arrival_s(
    ticks: Sequence[Tick],
    first: int,
    name: str,
    lane: int,
    at_m: float,
    limits: Mapping[str, Vehicle],
) -> float:
    """Return the time until a vehicle is at a place in a lane; infinite: never."""
    last = ticks[first][name]
    if last.s_m >= at_m:
        return 0.0
    for number in range(first + 1, len(ticks)):
        row = ticks[number].get(name)
        if row is None or lane not in touched(row, limits.get(name, CAR)):
            return math.inf
        if row.s_m >= at_m:
            share = (at_m - last.s_m) / (row.s_m - last.s_m)
            return TICK_S * (number - 1 - first + share)
        last = row
    return math.inf


def random_traffic(seed: int) -> tuple[list[Tick], dict[str, Vehicle]]:
    """Return cars and trucks that enter, leave, accelerate and change lanes at random."""
    rng = random.Random(seed)
    ticks: list[Tick] = []
    present: dict[str, Row] = {}
    limits: dict[str, Vehicle] = {}
    lateral_mps: dict[str, float] = {}
    for number in range(rng.randint(2, 150)):
        if rng.random() < 0.1:
            name = f"v{number}"
            if rng.random() < 0.3:
                limits[name] = TRUCK
            present[name] = Row(rng.uniform(0, 150), rng.uniform(1.0, 3 * LANE_M - 1.0))
        if present and rng.random() < 0.03:
            del present[rng.choice(sorted(present))]
        for name, row in present.items():
            if rng.random() < 0.05:
                lateral_mps[name] = rng.choice((-2.0, 0.0, 0.0, 2.0))
            accel = rng.choice((0.0, 0.0, rng.uniform(-12.0, 5.0)))
            speed = min(max(row.speed_mps + TICK_S * accel, 0.0), 30.0)
            y_m = min(max(row.y_m + TICK_S * lateral_mps.get(name, 0.0), 1.3), 3 * LANE_M - 1.3)
            present[name] = Row(row.s_m + TICK_S * speed, y_m, speed, accel)
        ticks.append(dict(present))
    return ticks, limits


@pytest.mark.parametrize("seed", range(60))
def test_measures_equal_a_plain_computation(seed: int) -> None:
    ticks, limits = random_traffic(seed)
    times_s, dracs_mps2 = [math.inf], [0.0]
    for tick in ticks:
        for gap_m, closing_mps in approaches(tick, limits):
            times_s.append(gap_m / closing_mps)
            if gap_m > 0.0:
                dracs_mps2.append(closing_mps**2 / (2.0 * gap_m))
    pets_s = [pet for pet in encroachments(ticks, limits) if pet <= 10.0]
    for batch in (1, 7, 10**6):
        found = measured(ticks, limits, batch)
        assert found.min_ttc_s == pytest.approx(min(times_s))
        assert found.max_drac_mps2 == pytest.approx(max(dracs_mps2))
        for limit_s, below_s in found.ttc_below_s.items():
            count = sum(time_s < limit_s for time_s in times_s)
            assert below_s == pytest.approx(TICK_S * count)
        assert found.min_pet_s == pytest.approx(min(pets_s, default=math.inf))
        rows = [row for tick in ticks for row in tick.values()]
        hard = {name for tick in ticks for name, row in tick.items() if row.accel_mps2 < -5.0}
        assert found.hard_brakes == len(hard)
        pairs = [
            (tick[name], before.get(name), limits.get(name, CAR).min_accel_mps2)
            for before, tick in pairwise([{}, *ticks])
            for name in tick
        ]
        episodes = sum(
            row.accel_mps2 < 0.9 * limit and (last is None or last.accel_mps2 >= 0.9 * limit)
            for row, last, limit in pairs
        )
        assert found.emergency_brakes == episodes
        jerks = [
            abs(row.accel_mps2 - before[name].accel_mps2) / TICK_S
            for before, tick in pairwise(ticks)
            for name, row in tick.items()
            if name in before
        ]
        assert found.max_jerk_mps3 == pytest.approx(max(jerks, default=-math.inf))
        assert found.min_accel_mps2 == min((row.accel_mps2 for row in rows), default=math.inf)
        if not jerks:
            assert found.comfort is None
            continue
        comfort = found.comfort
        assert comfort is not None
        accels = [abs(row.accel_mps2) for row in rows]
        assert comfort.accel_rms_mps2 == pytest.approx(
            np.sqrt(np.mean(np.square(accels))), abs=1e-3
        )
        assert comfort.jerk_rms_mps3 == pytest.approx(np.sqrt(np.mean(np.square(jerks))), abs=1e-3)
        p95 = np.percentile(accels, 95, method="inverted_cdf")
        assert comfort.accel_p95_mps2 == pytest.approx(p95, abs=0.0051)
        p95 = np.percentile(jerks, 95, method="inverted_cdf")
        assert comfort.jerk_p95_mps3 == pytest.approx(p95, abs=0.051)
        uncomfortable = [
            abs(row.accel_mps2) > 2.0 or abs(row.accel_mps2 - last.accel_mps2) > 0.25 + 1e-12
            for row, last, _ in pairs
            if last is not None
        ]
        share = 100.0 * sum(uncomfortable) / len(uncomfortable)
        assert comfort.uncomfortable_percent == pytest.approx(share, abs=1e-3)


def test_random_traffic_has_what_is_measured() -> None:
    found = [measured(*random_traffic(seed)) for seed in range(60)]
    assert sum(one.min_ttc_s < 1.5 for one in found) > 10
    assert sum(0.0 < one.min_pet_s < math.inf for one in found) > 10
    assert sum(one.emergency_brakes > 0 for one in found) > 10


# --- by hand ---------------------------------------------------------------------------------


def test_time_to_collision_and_deceleration() -> None:
    """At 20 m/s, 30 m behind the rear of a vehicle that drives at 10 m/s."""
    tick = {"a": Row(100.0, lane_y_m(0), 20.0), "b": Row(135.0, lane_y_m(0), 10.0)}
    found = measured([tick])
    assert found.min_ttc_s == pytest.approx(3.0)
    assert found.max_drac_mps2 == pytest.approx(100.0 / 60.0)
    assert measured([tick], {"b": TRUCK}).min_ttc_s == pytest.approx(2.3)
    beside = tick | {"b": Row(135.0, lane_y_m(1), 10.0)}
    assert measured([beside]).min_ttc_s == math.inf


def test_a_faster_vehicle_ahead_is_no_conflict() -> None:
    found = measured([{"a": Row(100.0, lane_y_m(0)), "b": Row(110.0, lane_y_m(0), 16.0)}])
    assert (found.min_ttc_s, found.max_drac_mps2) == (math.inf, 0.0)
    assert set(found.ttc_below_s.values()) == {0.0}


def test_a_closing_speed_of_nearly_nothing_is_no_conflict() -> None:
    y_m = lane_y_m(0)
    tick = {"a": Row(0.0, y_m, speed_mps=5e-324), "b": Row(30.0, y_m, speed_mps=0.0)}
    found = measured([tick])
    assert found.min_ttc_s == math.inf
    assert found.max_drac_mps2 == 0.0


def lane_change(after: int, behind_m: float, leaves_at: int = 10**6) -> list[Tick]:
    """Return ticks in which one vehicle changes lanes in front of another one, both at 15 m/s."""
    return [
        {
            "first": Row(100.0 + 1.5 * tick, lane_y_m(0 if tick < after else 1)),
            "second": Row(100.0 - behind_m + 1.5 * tick, lane_y_m(1 if tick < leaves_at else 2)),
        }
        for tick in range(60)
    ]


@pytest.mark.parametrize("batch", [1, 10**6])
def test_post_encroachment_time(batch: int) -> None:
    """The vehicle behind drives 20 m to where the rear was, 5 m behind the front."""
    found = measured(lane_change(5, 25.0), batch=batch)
    assert found.min_pet_s == pytest.approx(20.0 / 15.0)
    assert measured(lane_change(5, 25.0, leaves_at=10), batch=batch).min_pet_s == math.inf
    assert measured(lane_change(5, 2.0), batch=batch).min_pet_s == 0.0


def test_a_vehicle_that_changes_lanes_behind_another_one() -> None:
    ticks = [
        {
            "own": Row(100.0 + 1.5 * tick, lane_y_m(0 if tick < 5 else 1)),
            "ahead": Row(120.0 + 1.5 * tick, lane_y_m(1)),
        }
        for tick in range(60)
    ]
    assert measured(ticks).min_pet_s == pytest.approx(15.0 / 15.0)


def test_emergency_brakes_are_episodes_beyond_the_limit_of_the_type() -> None:
    accels = [0.0, -9.5, -10.0, -8.0, -9.1, -5.5, -5.6, 0.0]
    ticks = [{"a": Row(0.0, lane_y_m(0), 10.0, accel)} for accel in accels]
    for batch in (1, 3, 100):
        assert measured(ticks, batch=batch).emergency_brakes == 2
        assert measured(ticks, {"a": TRUCK}, batch).emergency_brakes == 1


def test_values_that_are_not_finite_are_left_out() -> None:
    ticks = [{"a": Row(1.5 * tick, lane_y_m(0))} for tick in range(9)]
    for wrong in (math.nan, math.inf):
        for bad in (
            Row(0.0, wrong),
            Row(wrong, 1.0),
            Row(0.0, 1.0, wrong),
            Row(0.0, 1.0, 1.0, wrong),
        ):
            found = measured([*ticks[:4], {"a": bad}, *ticks[5:]], batch=3)
            assert (found.min_accel_mps2, found.max_accel_mps2) == (0.0, 0.0)
            assert found.comfort is not None
    assert measured([{"a": Row(math.nan, 1.0)}]).comfort is None


def test_constant_speed_has_no_acceleration_and_extreme_values_are_kept() -> None:
    found = measured([{"a": Row(1.5 * tick, lane_y_m(0))} for tick in range(9)]).comfort
    assert found is not None
    assert (found.accel_p95_mps2, found.jerk_p95_mps3) == (0.0, 0.0)
    ticks = [{"a": Row(0.0, lane_y_m(0), 10.0, -90.0 * (tick % 2))} for tick in range(9)]
    found = measured(ticks).comfort
    assert found is not None
    assert (found.accel_p95_mps2, found.jerk_p95_mps3) == (90.0, 900.0)


def test_a_name_that_returns_is_another_trip() -> None:
    ticks = [{"a": Row(0.0, lane_y_m(0))}, *[{}] * 50, {"a": Row(0.0, lane_y_m(0), 15.0, 2.0)}]
    for batch in (1, 100):
        found = measured(ticks, batch=batch)
        assert (found.max_jerk_mps3, found.comfort) == (-math.inf, None)


def test_discomfort_is_a_share_of_time() -> None:
    accels = [0.0, 0.2, 0.4, 0.4, 2.1, 2.1, 2.0, 1.8, 1.6, 1.4, 1.4]
    ticks = [{"a": Row(0.0, lane_y_m(0), 10.0, accel)} for accel in accels]
    comfort = measured(ticks).comfort
    assert comfort is not None
    # The jerk to 2.1 is 17 m/s3; the next tick has 2.1 m/s2.
    assert comfort.uncomfortable_percent == pytest.approx(20.0)
