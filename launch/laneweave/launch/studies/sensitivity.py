"""How much the results of a method depend on single settings: one factor at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import fmean
from typing import Final

from attrs import frozen

from laneweave.launch.recordings.runs import Run
from laneweave.launch.run_methods import affects, labelled
from laneweave.launch.sweep.points import Variant
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.radio_table import C_V2X

BASE: Final = "base"
_ERRORS: Final = (
    "position_noise_m", "lateral_noise_m", "speed_noise_mps", "accel_noise_mps2", "gap_noise_m",
    "other_speed_noise_mps", "other_accel_noise_mps2",
)  # fmt: skip
_SHIFT: Final = 0.2
"""Relative change of volume and v_F."""
_S3_SHIFT: Final = 1.0 / 3.0
_TWICE: Final = 4.0
"""Factor of the measurement errors."""
_CYCLES_S: Final = (5.0, 7.0)
_MEMBERS: Final = 2
_DELAY_S: Final = 0.5
_LOSS: Final = 0.3


@frozen
class Level:
    """A factor at one of its ends."""

    text: str
    """Its value in words."""
    variant: Variant


@frozen
class Factor:
    """A setting that is varied, alone, to both sides or to one."""

    name: str
    low: Level | None
    """None: the base itself is the low end, or this end is impossible."""
    high: Level | None
    refused: tuple[str, ...] = ()
    """Why ends are impossible in this scenario."""

    @property
    def levels(self) -> tuple[Level, ...]:
        """The levels that differ from the base."""
        return tuple(one for one in (self.low, self.high) if one is not None)


def factors_of(method: str, base: Scenario) -> tuple[Factor, ...]:
    """Return the factors that can change the results of a method on a road."""
    return tuple(_factors(method, base))


def _factors(method: str, base: Scenario) -> Iterator[Factor]:
    kind = labelled(method).method

    def factor(name: str, *ends: tuple[str, Mapping[str, object]] | None) -> Iterator[Factor]:
        levels, refused = list[Level | None](), list[str]()
        for side, end in zip(("low", "high"), ends, strict=True):
            if end is None or not all(affects(field, kind) for field in end[1]):
                levels.append(None)
                continue
            text, settings = end
            variant = Variant(f"{name.replace(' ', '-')}-{side}", settings)
            try:
                variant.scenario(method, base)
            except BadInputError as error:
                refused.append(f"{name} {text}: {error}")
                levels.append(None)
            else:
                levels.append(Level(text, variant))
        if refused or any(levels):
            low, high = levels
            yield Factor(name, low, high, tuple(refused))

    def scaled(
        field: str, value: float, shift: float, unit: str
    ) -> Iterable[tuple[str, Mapping[str, object]]]:
        for sign in (-1.0, 1.0):
            changed = float(f"{value * (1.0 + sign * shift):.4g}")
            yield f"{changed:g} {unit}", {field: changed}

    lanes = base.road.lanes
    if lanes > 1 and not (base.entrance or base.exit or base.demand.destinations):
        others = 0.4 / (lanes - 1)
        right, left = [0.6, *[others] * (lanes - 1)], [*[others] * (lanes - 1), 0.6]
        yield from factor(
            "preferred lanes",
            ("60 % the right one", {"demand.lane_shares": right}),
            ("60 % the left one", {"demand.lane_shares": left}),
        )
    volume = base.demand.volume_veh_per_lane_h
    yield from factor(
        "volume", *scaled("demand.volume_veh_per_lane_h", volume, _SHIFT, "veh/(lane h)")
    )
    yield from factor("length of S3", *scaled("road.s3_m", base.road.s3_m, _S3_SHIFT, "m"))
    yield from factor(
        "v_F", *scaled("formation.speed_mps", base.formation.speed_mps, _SHIFT, "m/s")
    )
    short_s, long_s = _CYCLES_S
    yield from factor(
        "T_F",
        (f"{short_s:g} s", {"formation.cycle_s": short_s}),
        (f"{long_s:g} s", {"formation.cycle_s": long_s}),
    )
    if base.formation.traits.has_formations:
        members = base.formation.max_vehicles
        yield from factor(
            "N",
            (f"{members - _MEMBERS}", {"formation.max_vehicles": members - _MEMBERS}),
            (f"{members + _MEMBERS}", {"formation.max_vehicles": members + _MEMBERS}),
        )
    yield from factor(
        "measurement errors",
        ("none", {f"sensing.{name}": 0.0 for name in _ERRORS}),
        (
            f"{_TWICE:g} times",
            {f"sensing.{name}": _TWICE * getattr(base.sensing, name) for name in _ERRORS},
        ),
    )
    radio = {"radio.technology": C_V2X} if not base.radio.enabled else {}
    yield from factor(
        "delay", None, (f"{_DELAY_S:g} s", {**radio, "radio.cellular_delay_s": _DELAY_S})
    )
    lossy = {"radio.cellular_loss": _LOSS, "radio.burst_share": _LOSS}
    yield from factor("loss", None, (f"{100 * _LOSS:g} %, in bursts", {**radio, **lossy}))


@frozen
class Result:
    """Results of the base or of a level, over its runs."""

    runs: int
    delay_s: float | None
    """Mean travel time beyond that at v_F from the first to the last metre of the road."""
    in_lane_percent: float | None
    min_ttc_s: float | None
    min_gap_m: float | None
    co2_g_per_km: float | None
    """Of petrol cars."""
    overlaps: int
    not_left: int
    """Number of vehicles that have not left the road."""


def result_of(runs: Sequence[Run]) -> Result:
    """Return the results of runs that differ in their seeds only."""
    found = [(run, run.summary) for run in runs if run.summary is not None]
    delays_s = [
        mean_s - run.scenario.road.length_m / run.scenario.formation.speed_mps
        for run, summary in found
        if (mean_s := summary.travel_time_s.mean) is not None
    ]
    summaries = [summary for _, summary in found]
    petrol = [
        one.energy["petrol"].co2_g_per_km
        for one in summaries
        if one.energy is not None and "petrol" in one.energy
    ]
    return Result(
        runs=len(found),
        delay_s=_mean(delays_s),
        in_lane_percent=_mean(
            [share for run, _ in found if (share := run.preferred_percent) is not None]
        ),
        min_ttc_s=_least(one.safety.min_ttc_s for one in summaries),
        min_gap_m=_least(one.safety.min_gap_m for one in summaries),
        co2_g_per_km=_mean(petrol),
        overlaps=sum(one.safety.overlaps for one in summaries),
        not_left=sum(one.vehicles.demanded - one.vehicles.left for one in summaries),
    )


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None


def _least(values: Iterable[float | None]) -> float | None:
    return min((one for one in values if one is not None), default=None)


def by_effect(
    factors: Iterable[Factor], results: Mapping[str, Result], base: Result
) -> list[Factor]:
    """Return the factors, that with the largest effect on the mean delay first."""

    def effect_s(factor: Factor) -> float:
        known = [results[one.variant.label].delay_s for one in factor.levels]
        delays_s = [one for one in (*known, base.delay_s) if one is not None]
        return max(delays_s, default=0.0) - min(delays_s, default=0.0)

    return sorted(factors, key=effect_s, reverse=True)
