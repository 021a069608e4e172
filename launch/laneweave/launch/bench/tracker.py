"""`laneweave bench tracker`: CPU time of tracking per tick.

Ticks are recorded in seeded closed loops with small measurement errors: situations in which another
vehicle limits the motion, and undisturbed holds and moves. The ticks are then solved again in
order, several times; the result is each tick's median CPU time on one thread.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np
from attrs import frozen
from numpy.typing import NDArray
from rich import box
from rich.table import Table

from laneweave.agents.driving.reference import Reference, Window
from laneweave.agents.driving.stopping_points import SENSED_S
from laneweave.agents.driving.tracker import Tracker, TrackResult
from laneweave.agents.driving.tracking_problem import NO_GAPS, Gaps
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State, integrate
from laneweave.sim_bridge.recording.statistics import percentiles_of

Array = NDArray[np.float64]

_REPEATS = 3
_NOISE = (0.05, 0.02, 0.05, 0.05, 0.02, 0.05)
"""Standard deviations of the measured (s, v, a, y, v_y, a_y)."""
_PUSH_TICKS = 20


@frozen(eq=False)
class Episode:
    """One simulation of a situation."""

    reference: Reference
    ticks: int
    rear_m: Callable[[Array], Array] | None = None
    """Function that returns the vehicle ahead's rear bumper positions at given times [s]."""
    seen_s: float = 0.0
    """Time at which the vehicle ahead is first seen."""
    planned: bool = True
    """Whether the motion of the vehicle ahead is known; otherwise it is extrapolated."""
    pushes: tuple[tuple[float, float], ...] = ()
    """Changes in position [m] and speed [m/s] of the body, one every `_PUSH_TICKS` ticks."""


@frozen(eq=False)
class Tick:
    """Input and result of the tracker at one tick."""

    state: State
    window: Window
    gaps: Gaps
    result: TrackResult


def drive(tracker: Tracker, scenario: Scenario, name: str, seed: str) -> Iterator[Tick]:
    """Simulate an episode of a situation in closed loop with an exact plant.

    Args:
        tracker: a new tracker.
        scenario: limits, tick and horizon.
        name: name of the situation; see `SITUATIONS`.
        seed: seed of the episode.
    """
    rng = random.Random(seed)  # noqa: S311 (not for secrets)
    episode = SITUATIONS[name](scenario, rng)
    tick_s = scenario.runtime.tick_s
    ahead_s = np.array([tick_s * k for k in range(scenario.timing.horizon_ticks + 1)])
    body = _as_state(episode.reference.window(0).states[0])
    for tick in range(episode.ticks):
        if tick and tick % _PUSH_TICKS == 0 and tick // _PUSH_TICKS <= len(episode.pushes):
            by_m, by_mps = episode.pushes[tick // _PUSH_TICKS - 1]
            body = (body[0] + by_m, body[1] + by_mps, *body[2:])
        noise = [rng.gauss(0.0, sigma) for sigma in _NOISE]
        state = _as_state(np.array(body) + noise)
        window = episode.reference.window(tick)
        rear = _predicted(episode, tick * tick_s, ahead_s)
        gaps = NO_GAPS if rear is None else Gaps(latest=rear - scenario.tracking.min_gap_m)
        result = tracker.solve(state, window, gaps)
        yield Tick(state, window, gaps, result)
        along, across = result.jerk[0].tolist()
        body = integrate(body, (along, across), tick_s)


def bench_tracker(
    scenario: Scenario, *, instances: int, seed: int, repeats: int = _REPEATS
) -> list[dict[str, Any]]:
    """Measure the tracker on recorded ticks.

    Args:
        scenario: limits, tick and horizon.
        instances: episodes per situation.
        seed: seed for all episodes.
        repeats: number of measurements of each tick.

    Returns:
        One row per situation.
    """
    rows = []
    for name in SITUATIONS:
        cpu_ms, osqp, unusable = [], 0, 0
        for index in range(instances):
            tracker = Tracker(scenario, scenario.vehicle)
            ticks = list(drive(tracker, scenario, name, f"{seed} {name} {index}"))
            cpu_ms.append(np.median([_replay(scenario, ticks) for _ in range(repeats)], axis=0))
            osqp += sum(tick.result.iterations > 0 for tick in ticks)
            unusable += sum(not tick.result.usable for tick in ticks)
        every = np.concatenate(cpu_ms)
        rows.append(
            {
                "situation": name,
                "ticks": len(every),
                "osqp_ticks": osqp,
                "unusable": unusable,
                "cpu_ms": {
                    "mean": round(float(every.mean()), 3),
                    **percentiles_of(every, 50, 99, largest=True),
                },
            }
        )
    return rows


def _replay(scenario: Scenario, ticks: Sequence[Tick]) -> Array:
    """Solve the ticks of an episode again; return the CPU time [ms] of each."""
    tracker = Tracker(scenario, scenario.vehicle)
    tracker.program.set_up()
    times_s = [time.thread_time()]
    for tick in ticks:
        tracker.solve(tick.state, tick.window, tick.gaps)
        times_s.append(time.thread_time())
    return np.diff(times_s) * 1e3


def tracker_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the results of `bench_tracker` as a table."""
    table = Table(
        "situation",
        "ticks",
        "OSQP ran",
        "CPU ms mean",
        "p50",
        "p99",
        "max",
        caption="CPU ms of one thread",
        box=box.SIMPLE_HEAD,
    )
    for row in rows:
        table.add_row(
            row["situation"],
            str(row["ticks"]),
            str(row["osqp_ticks"]),
            *(f"{row['cpu_ms'][name]:.3f}" for name in ("mean", "p50", "p99", "max")),
        )
    return table


def _predicted(episode: Episode, now_s: float, ahead_s: Array) -> Array | None:
    """Return the predicted rear bumper positions of the vehicle ahead; None if none is seen."""
    if episode.rear_m is None or now_s < episode.seen_s:
        return None
    if episode.planned:
        return episode.rear_m(now_s + ahead_s)
    now_m, soon_m = episode.rear_m(now_s + np.array([0.0, 0.01]))
    rear = now_m + (soon_m - now_m) / 0.01 * ahead_s
    rear[ahead_s > SENSED_S + 1e-9] = np.inf
    return np.asarray(rear)


def _as_state(numbers: Array) -> State:
    s, v, a, y, v_y, a_y = numbers.tolist()
    return s, v, a, y, v_y, a_y


def _braking(
    scenario: Scenario, gap_m: float, start_s: float, decel: float, speed_mps: float
) -> Callable[[Array], Array]:
    """Return the rear bumper position, as a function of time, of a vehicle that brakes from v_F.

    Args:
        scenario: defines v_F.
        gap_m: initial distance from the front bumper of a vehicle in column 0.
        start_s: time at which the vehicle begins to brake.
        decel: deceleration [m/s2].
        speed_mps: final speed.
    """
    before_mps = scenario.lattice.speed_mps
    until_s = (before_mps - speed_mps) / decel
    rear_m = scenario.lattice.cell_s_m(0, 0.0) + gap_m

    def rear(t_s: Array) -> Array:
        late_s = np.maximum(t_s - start_s, 0.0)
        braked_s = np.minimum(late_s, until_s)
        lost_m = decel * braked_s * (late_s - braked_s / 2.0)
        return np.asarray(rear_m + before_mps * t_s - lost_m)

    return rear


def _net_gap_m(scenario: Scenario, cells: int) -> float:
    return cells * scenario.formation.gap_m - scenario.vehicle.length_m


def _slower_ahead(scenario: Scenario, rng: random.Random) -> Episode:
    start_s, decel, speed_mps = rng.uniform(0.5, 2.0), rng.uniform(2.0, 5.0), rng.uniform(4.0, 12.0)
    rear = _braking(scenario, _net_gap_m(scenario, 1), start_s, decel, speed_mps)
    reference = Reference.hold(scenario, scenario.vehicle, (0, 1))
    return Episode(reference, 80, rear, planned=_is_planned(rng))


def _closing(scenario: Scenario, rng: random.Random) -> Episode:
    start_s, decel, speed_mps = rng.uniform(0.5, 3.0), rng.uniform(1.5, 2.5), rng.uniform(5.0, 11.0)
    rear = _braking(scenario, _net_gap_m(scenario, 2), start_s, decel, speed_mps)
    reference = Reference.move(scenario, scenario.vehicle, (0, 1), (1, 1), rng.randrange(10))
    return Episode(reference, 80, rear, planned=_is_planned(rng))


def _falling_back(scenario: Scenario, rng: random.Random) -> Episode:
    """Return a late backward move that begins close behind a braking vehicle."""
    start_s, decel, speed_mps = rng.uniform(0.5, 2.0), rng.uniform(1.0, 3.0), rng.uniform(8.0, 12.0)
    rear = _braking(scenario, rng.uniform(4.0, 10.0), start_s, decel, speed_mps)
    reference = Reference.move(scenario, scenario.vehicle, (0, 1), (-1, 1), rng.randrange(15))
    return Episode(reference, 80, rear, planned=_is_planned(rng), pushes=_pushes(rng))


def _close_behind(scenario: Scenario, rng: random.Random) -> Episode:
    """Return a hold behind a vehicle, at slightly more than the minimum gap."""
    gap_m = scenario.tracking.min_gap_m + rng.uniform(0.1, 2.0)
    rear = _braking(scenario, gap_m, 0.0, 1.0, scenario.lattice.speed_mps)
    reference = Reference.hold(scenario, scenario.vehicle, (0, 1))
    return Episode(reference, 80, rear, planned=_is_planned(rng), pushes=_pushes(rng))


def _pushes(rng: random.Random) -> tuple[tuple[float, float], ...]:
    return tuple((rng.uniform(0.3, 2.0), rng.uniform(0.0, 2.0)) for _ in range(3))


def _entering(scenario: Scenario, rng: random.Random) -> Episode:
    """Return a change to a lane in which a slow vehicle is seen when the change begins."""
    start, tick_s = rng.randrange(10), scenario.runtime.tick_s
    seen_s, gap_m, speed_mps = start * tick_s, rng.uniform(4.0, 10.0), rng.uniform(8.0, 12.0)
    # The vehicle ahead is at its final speed when it is first seen.
    rear = _braking(scenario, gap_m, seen_s - tick_s, 15.0 / tick_s, speed_mps)
    reference = Reference.move(scenario, scenario.vehicle, (0, 1), (0, rng.choice((0, 2))), start)
    return Episode(reference, 80, rear, seen_s, planned=_is_planned(rng))


def _is_planned(rng: random.Random) -> bool:
    # A vehicle that is only sensed is noticed late, which makes gap constraints active.
    return rng.random() < 0.3


def _undisturbed(scenario: Scenario, rng: random.Random) -> Episode:
    """Return a hold or a move; in half of the episodes there is a vehicle two cells ahead."""
    dx, dy = rng.choice([(0, 0), (0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    reference = Reference.hold(scenario, scenario.vehicle, (0, 1))
    if dx or dy:
        reference = Reference.move(scenario, scenario.vehicle, (0, 1), (dx, 1 + dy), 10)
    rear = _braking(scenario, _net_gap_m(scenario, 2), 0.0, 1.0, scenario.lattice.speed_mps)
    return Episode(reference, 60, rng.choice((None, rear)), planned=_is_planned(rng))


SITUATIONS: Final[dict[str, Callable[[Scenario, random.Random], Episode]]] = {
    "slower ahead": _slower_ahead,
    "closing": _closing,
    "falling back": _falling_back,
    "close behind": _close_behind,
    "entering": _entering,
    "undisturbed": _undisturbed,
}
