"""How much the results of a method depend on single settings: one factor at a time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import fmean
from typing import Final

from attrs import frozen

from laneweave.launch.recordings.runs import Run
from laneweave.launch.run_methods import LabelledMethod, affects, labelled
from laneweave.launch.sweep.points import checked_settings
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.radio_table import C_V2X, Radio
from laneweave.protocol.summary import Ending

BASE: Final = "base"
_ERRORS: Final = (
    "position_noise_m", "lateral_noise_m", "speed_noise_mps", "accel_noise_mps2", "gap_noise_m",
    "other_speed_noise_mps", "other_accel_noise_mps2",
)  # fmt: skip
_SHIFT: Final = 0.2
"""Relative change of the volume."""
_SPEED_SHIFT: Final = 0.1
"""Relative change of v_F."""
_S3_SHIFT: Final = 1.0 / 3.0
"""Relative change of the length of S3."""
_ERROR_FACTOR: Final = 1.5
"""Factor of the measurement errors."""
_CYCLES_S: Final = (5.0, 7.0)
"""Low and high end of T_F."""
_MEMBERS: Final = 2
"""Change of the maximum number of vehicles in a formation."""
_DELAY_S: Final = 0.5
"""Additional delay of messages by the cellular network."""
_LOSS: Final = 0.3
"""Added to the loss in the cellular network and to the share of time in bursts."""
_MAX_LOSS: Final = 0.9
"""Upper bound of both sums; larger values of the scenario are kept."""


@frozen
class Level:
    """A factor at one of its ends."""

    label: str
    """Label of its runs."""
    text: str
    """Value as text."""
    method: LabelledMethod


@frozen
class Factor:
    """A setting with its levels; all other settings are those of the base."""

    name: str
    low: Level | None
    """None: the setting of the base is the low end, or the scenario does not allow the low end."""
    high: Level | None
    refused: tuple[str, ...] = ()
    """Why ends are impossible in this scenario."""

    @property
    def levels(self) -> tuple[Level, ...]:
        """The levels that differ from the base."""
        return tuple(one for one in (self.low, self.high) if one is not None)


End = tuple[str, Mapping[str, object]]
"""Value of a factor as text, and the settings for it."""


def factors_of(label: str, base: Scenario) -> tuple[Factor, ...]:
    """Return the factors that can change the results of a method on a road.

    Args:
        label: label of the method.
        base: scenario in which the method drives.
    """
    known = labelled(label)
    found = []
    for name, ends in _ends(known.settings(base)):
        levels, refused = list[Level | None](), list[str]()
        for side, end in zip(("low", "high"), ends, strict=True):
            level = None
            if end is not None and all(affects(field, known.method) for field in end[1]):
                text, settings = end
                method = known.with_overrides(settings)
                try:
                    checked_settings(method, base)
                except BadInputError as error:
                    refused.append(f"{name} {text}: {error}")
                else:
                    level = Level(f"{name.replace(' ', '-')}-{side}", text, method)
            levels.append(level)
        low, high = levels
        if low or high or refused:
            found.append(Factor(name, low, high, tuple(refused)))
    return tuple(found)


def _ends(own: Scenario) -> Iterator[tuple[str, tuple[End | None, End | None]]]:
    """Yield the name and the ends of each factor, given the scenario of the method itself."""
    road, formation, lanes = own.road, own.formation, own.road.lanes
    if lanes > 1 and own.flow.lane_shares:
        others = 0.4 / (lanes - 1)
        right, left = [0.6, *[others] * (lanes - 1)], [*[others] * (lanes - 1), 0.6]
        yield (
            "preferred lanes",
            (
                ("60 % the right one", {"demand.lane_shares": right}),
                ("60 % the left one", {"demand.lane_shares": left}),
            ),
        )
    volume = own.demand.volume_veh_per_lane_h
    yield "volume", _scaled("demand.volume_veh_per_lane_h", volume, _SHIFT, "veh/(lane h)")
    yield "length of S3", _scaled("road.s3_m", road.s3_m, _S3_SHIFT, "m")
    yield "v_F", _scaled("formation.speed_mps", formation.speed_mps, _SPEED_SHIFT, "m/s")
    short, long = ((f"{one:g} s", {"formation.cycle_s": one}) for one in _CYCLES_S)
    yield "T_F", (short, long)
    if formation.traits.has_formations:
        fewer, more = (
            (f"{count}", {"formation.max_vehicles": count})
            for count in (formation.max_vehicles - _MEMBERS, formation.max_vehicles + _MEMBERS)
        )
        yield "N", (fewer, more)
    none, large = (
        {f"sensing.{name}": factor * getattr(own.sensing, name) for name in _ERRORS}
        for factor in (0.0, _ERROR_FACTOR)
    )
    yield "measurement errors", (("none", none), (f"{_ERROR_FACTOR:g} times", large))
    yield from _radio_ends(own.radio)


def _radio_ends(radio: Radio) -> Iterator[tuple[str, tuple[None, End]]]:
    """Yield the factors of the radio; without one, delay and loss are those of a radio, too."""
    enabled: dict[str, object] = {}
    if not radio.enabled:
        enabled = {"radio.technology": C_V2X}
        yield "radio", (None, ("C-V2X", enabled))
    delay_s = radio.cellular_delay_s + _DELAY_S
    text = f"{delay_s:g} s by the network"
    yield "delay", (None, (text, {**enabled, "radio.cellular_delay_s": delay_s}))
    loss, share = (
        round(max(one, min(one + _LOSS, _MAX_LOSS)), 6)
        for one in (radio.cellular_loss, radio.burst_share)
    )
    if (loss, share) != (radio.cellular_loss, radio.burst_share):
        settings = {**enabled, "radio.cellular_loss": loss, "radio.burst_share": share}
        text = f"{100.0 * loss:g} %, and in bursts for {100.0 * share:g} % of the time"
        yield "loss", (None, (text, settings))


def _scaled(field: str, value: float, shift: float, unit: str) -> tuple[End, End]:
    low, high = (float(f"{value * (1.0 + sign * shift):.4g}") for sign in (-1.0, 1.0))
    return (f"{low:g} {unit}", {field: low}), (f"{high:g} {unit}", {field: high})


@frozen
class Result:
    """Results of the base or of a level, over its runs."""

    runs: int
    delay_s: float | None
    """Mean of `TravelTime.delay_s` over the runs in which all vehicles have left."""
    delays_s: tuple[float, ...]
    """The same of each of these runs."""
    arrived_percent: float | None
    """Share of the departed vehicles that left in their lane, or at their exit."""
    min_ttc_s: float | None
    min_gap_m: float | None
    co2_g_per_km: float | None
    """Of petrol cars."""
    overlaps: int
    not_left: int
    """Number of vehicles that have not left the road."""
    failed: int = 0
    """Number of runs that failed; those without a summary count only here and in `runs`."""


def result_of(runs: Sequence[Run]) -> Result:
    """Return the results of runs that differ in their seeds only."""
    delays_s = [
        delay_s
        for run in runs
        if run.summary is not None
        and run.summary.ending == Ending.COMPLETE.value
        and (delay_s := run.summary.travel_time_s.delay_s) is not None
    ]
    summaries = [run.summary for run in runs if run.summary is not None]
    petrol = [
        one.energy["petrol"].co2_g_per_km
        for one in summaries
        if one.energy is not None and "petrol" in one.energy
    ]
    return Result(
        runs=len(runs),
        delay_s=_mean(delays_s),
        delays_s=tuple(delays_s),
        arrived_percent=_mean(
            [share for one in summaries if (share := one.preferred_percent) is not None]
        ),
        min_ttc_s=_minimum(one.safety.min_ttc_s for one in summaries),
        min_gap_m=_minimum(one.safety.min_gap_m for one in summaries),
        co2_g_per_km=_mean(petrol),
        overlaps=sum(one.safety.overlaps for one in summaries),
        not_left=sum(one.vehicles.demanded - one.vehicles.left for one in summaries),
        failed=sum(bool(run.reason) for run in runs),
    )


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None


def _minimum(values: Iterable[float | None]) -> float | None:
    return min((one for one in values if one is not None), default=None)


def by_effect(factors: Iterable[Factor], results: Mapping[str, Result]) -> list[Factor]:
    """Return the factors, that with the largest effect on the mean delay first.

    The effect of a level with which no run finished is infinite.
    """
    base_s = results[BASE].delay_s

    def effect_s(factor: Factor) -> float:
        levels = [results[one.label] for one in factor.levels]
        if any(one.failed and one.delay_s is None for one in levels):
            return math.inf
        known = [base_s, *(one.delay_s for one in levels)]
        delays_s = [one for one in known if one is not None]
        return max(delays_s, default=0.0) - min(delays_s, default=0.0)

    return sorted(factors, key=effect_s, reverse=True)
