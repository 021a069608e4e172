"""The paper's statements about its results (Section 5.2), beside what was measured here.

Each statement has a rule that computes its verdict from the data.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from attrs import frozen

from evaluation.evidence import Evidence
from evaluation.markdown import HOLDS, MISSING, markdown, number
from evaluation.points import PointRow
from evaluation.programme import SEEDS, VOLUMES, paper_bound, planned

PAPER_VOLUMES: Final = (1000.0, 1150.0, 1300.0, 1450.0, 1600.0)
"""At which the paper compares, in vehicles/(lane h)."""
READINGS: Final = ("rule", "rule-net", "rule-yielding")
"""The readings of its rules."""
OWN: Final = "paper-6"
"""Formation control as the paper runs it: at most six vehicles."""
CLOSED: Final = ("formations", OWN, "paper-12")
"""Closed formations: the default ones, and the paper's."""
ALIKE_S: Final = 1.0
"""Methods are alike if their mean travel times differ by at most this."""
STABLE: Final = 1.05
"""Travel times are stable if they grow by no more than this factor from 1000 to 1600."""
CONGESTED: Final = 1.25
"""A method is congested if its mean travel time exceeds this multiple of free flow."""
UNDISTURBED: Final = 0.9
"""Speeds are undisturbed if no stretch of road is below this share of v_F on average."""
CARRIED: Final = 0.97
"""A volume is carried if the throughput is at least this share of it."""
PAPER_STRETCH_M: Final = (500.0, 800.0)
STRETCH_ERROR_M: Final = 50.0
"""One bin of the road more or less."""

FAILS, DEPENDS, OTHERWISE = "**does not hold**", "depends on the reading", ""


@frozen
class Statement:
    """A statement of the paper, and its verdict."""

    text: str
    measured: str
    verdict: str


def statements_table(evidence: Evidence) -> str:
    """Return the table of all statements."""
    rows = [(one.text, one.measured, one.verdict) for one in _Judge(evidence).statements()]
    table = markdown(["the paper", "here", ""], rows)
    few = any(len(row.seeds) < len(SEEDS) for row in evidence.points)
    note = f"Not all of this rests on {len(SEEDS)} seeds yet: see the table of runs."
    return f"{table}\n\n{note}" if few else table


@frozen
class _Judge:
    evidence: Evidence

    def statements(self) -> Iterator[Statement]:
        """Yield all statements."""
        yield self._stable()
        yield self._rules_grow()
        yield self._congestion()
        yield self._where()
        yield self._smooth()
        yield self._better()
        yield self._alike_below()
        yield self._bound()
        yield self._safe()
        yield self._rules_complete()
        yield self._sumo_blocks()
        yield self._six()

    def _row(self, label: str, volume: float) -> PointRow | None:
        row = self.evidence.by_key.get((label, volume))
        return row if row is not None and row.seeds else None

    def _travel_s(self, label: str, volume: float) -> float | None:
        row = self._row(label, volume)
        return None if row is None else row.travel_s

    def _stable(self) -> Statement:
        text = "The travel time of formation control stays stable from 1000 to 1600 veh/(lane h)"
        parts: list[str] = []
        kept: list[bool | None] = []
        for label in CLOSED:
            low_s, high_s = (self._travel_s(label, volume) for volume in (1000.0, 1600.0))
            if low_s is None or high_s is None:
                parts.append(f"`{label}` {MISSING}")
                kept.append(None)
                continue
            kept.append(high_s <= STABLE * low_s)
            growth = 100.0 * (high_s / low_s - 1.0)
            parts.append(f"`{label}` {low_s:.2f} s, then {high_s:.2f} s ({growth:+.1f} %)")
        return Statement(text, "; ".join(parts), _all(kept))

    def _rules_grow(self) -> Statement:
        text = "The travel time under the rules goes up with the volume"
        parts: list[str] = []
        kept: list[bool | None] = []
        for label in READINGS:
            times = [self._travel_s(label, volume) for volume in PAPER_VOLUMES]
            known = [t_s for t_s in times if t_s is not None]
            parts.append(f"`{label}` {_series([number(t_s, 1) for t_s in times], known)}")
            kept.append(known == sorted(known) if len(known) == len(times) else None)
        return Statement(text, "; ".join(parts), _all(kept))

    def _congested_from(self, label: str) -> tuple[float | None, float | None]:
        """Return the lowest congested volume, and the highest measured one below it."""
        setting = self.evidence.setting
        times = {
            row.volume_veh_per_lane_h: row.travel_s
            for row in self.evidence.points
            if row.label == label and row.travel_s is not None
        }
        if setting is None:
            return None, None
        most_s = CONGESTED * setting.free_flow_s
        first = min((volume for volume, t_s in times.items() if t_s > most_s), default=None)
        below = (volume for volume in times if first is None or volume < first)
        return first, max(below, default=None)

    def _rows(self, *labels: str) -> tuple[list[PointRow], list[bool | None]]:
        """Return all points of labels, and None for each planned point that is missing."""
        rows = [
            self._row(label, volume)
            for label in labels
            for volume in VOLUMES
            if planned(label, volume)
        ]
        return [row for row in rows if row is not None], [None for row in rows if row is None]

    def _congestion(self) -> Statement:
        text = "Severe congestion under the rules at 1450 and 1600, none with formation control"
        parts: list[str] = []
        kept: list[bool | None] = []
        for label in (*READINGS, *CLOSED, "lc2013"):
            first, below = self._congested_from(label)
            if label in READINGS:
                known = self._row(label, 1450.0) is not None
                kept.append(first is not None and first <= 1450.0 if known else None)
            parts.append(f"`{label}` {_onset(first, below)}")
        return Statement(text, "congested: " + "; ".join(parts), _some(kept))

    def _where(self) -> Statement:
        text = "The congestion is at 500 to 800 m"
        parts: list[str] = []
        kept: list[bool | None] = []
        for label in READINGS:
            first, _ = self._congested_from(label)
            row = None if first is None else self._row(label, first)
            if row is None or row.traced is None or row.traced.slow_m is None:
                kept.extend(self._rows(label)[1][:1])
                continue
            from_m, to_m = row.traced.slow_m
            low_m, high_m = PAPER_STRETCH_M
            kept.append(from_m >= low_m - STRETCH_ERROR_M and to_m <= high_m + STRETCH_ERROR_M)
            parts.append(f"`{label}` at {first:g}: {from_m:g} to {to_m:g} m")
        measured = "; ".join(parts) or MISSING
        return Statement(text, f"mean speed below v_F / 2: {measured}", _some(kept))

    def _smooth(self) -> Statement:
        text = "Formations disturb speeds a little near the beginning, and then drive at v_F"
        row, setting = self._row(OWN, 1600.0), self.evidence.setting
        if row is None or setting is None or row.traced is None or row.traced.slowest_mps is None:
            return Statement(text, MISSING, "")
        slowest = row.traced.slowest_mps
        measured = (
            f"`{OWN}` at 1600: no 50 m of road are slower than {slowest:.2f} m/s on average; "
            "vehicles wait for their cell before they enter"
        )
        return Statement(text, measured, _all([slowest >= UNDISTURBED * setting.speed_mps]))

    def _better(self) -> Statement:
        text = "Formation control is faster than the rules at these volumes"
        parts: list[str] = []
        kept: list[bool | None] = []
        for label in READINGS:
            gains = []
            for volume in PAPER_VOLUMES:
                rule_s, own_s = self._travel_s(label, volume), self._travel_s(OWN, volume)
                gains.append(None if rule_s is None or own_s is None else rule_s - own_s)
            texts = ["-" if gain is None else f"{gain:+.1f}" for gain in gains]
            known = [gain for gain in gains if gain is not None]
            parts.append(f"`{label}` minus `{OWN}` {_series(texts, known)}")
            kept.append(all(gain > 0.0 for gain in known) if len(known) == len(gains) else None)
        return Statement(text, "; ".join(parts), _some(kept))

    def _alike_below(self) -> Statement:
        text = "Below 1000 the methods are alike"
        parts: list[str] = []
        kept: list[bool | None] = []
        for volume in (500.0, 750.0):
            times = [self._travel_s(label, volume) for label in (OWN, *READINGS)]
            known = [t_s for t_s in times if t_s is not None]
            parts.append(f"at {volume:g}: {_series([number(t_s, 1) for t_s in times], known)}")
            whole = len(known) == len(times)
            kept.append(max(known) - min(known) <= ALIKE_S if whole else None)
        whose = ", ".join(f"`{label}`" for label in (OWN, *READINGS))
        return Statement(text, f"{whose} {'; '.join(parts)}", _all(kept))

    def _bound(self) -> Statement:
        row, setting = self._row("paper-12", 1750.0), self.evidence.setting
        text = "At most 3600 v_F / 2 d_F can be carried"
        if row is None or row.throughput_veh_per_lane_h is None or setting is None:
            return Statement(text, MISSING, "")
        bound = paper_bound(setting.speed_mps, setting.pitch_m)
        text += f", here {bound:g} veh/(lane h)"
        rate = row.throughput_veh_per_lane_h
        measured = f"`paper-12` carries {rate:.0f} of 1750"
        beyond = [
            f"`{label}` carries {found.throughput_veh_per_lane_h:.0f} of {volume:g}"
            for label, volume in (("formations", 2000.0), ("rolling", 2400.0))
            for found in (self._row(label, volume),)
            if found is not None and (found.throughput_veh_per_lane_h or 0.0) > bound
        ]
        if beyond:
            measured += "; the bound is one of the interlaced entry, not of the lattice: "
            measured += ", ".join(beyond)
        return Statement(text, measured, _all([rate >= CARRIED * 1750.0]))

    def _safe(self) -> Statement:
        text = "Formation control plans ways without collisions, to the preferred lanes"
        rows, missing = self._rows(*CLOSED)
        if not rows:
            return Statement(text, MISSING, "")
        off = sum(row.demanded - row.on_preferred_lane for row in rows)
        overlaps = sum(row.overlaps for row in rows)
        vehicles = sum(row.demanded for row in rows)
        measured = f"{overlaps} overlaps, {off} of {vehicles:,} vehicles not on their lane"
        return Statement(text, measured, _all([not overlaps and not off, *missing]))

    def _rules_complete(self) -> Statement:
        text = "The rules bring everybody to the preferred lane, whatever the traffic"
        rows, missing = self._rows(*READINGS)
        if not rows:
            return Statement(text, MISSING, "")
        off = sum(row.demanded - row.on_preferred_lane for row in rows)
        measured = f"{off} of {sum(row.demanded for row in rows):,} did not get there"
        return Statement(text, measured, _all([not off, *missing]))

    def _sumo_blocks(self) -> Statement:
        text = "SUMO's own lane changing may block itself at the end of the road"
        rows, missing = self._rows("lc2013")
        if not rows:
            return Statement(text, MISSING, "")
        off = sum(row.demanded - row.on_preferred_lane for row in rows)
        last = rows[-1]
        measured = (
            f"`lc2013`: {off} of {sum(row.demanded for row in rows):,} did not get to their lane; "
            f"{number(last.travel_s, 1)} s at {last.volume_veh_per_lane_h:g}"
        )
        return Statement(text, measured, _so_far("not seen" if not off else HOLDS, missing))

    def _six(self) -> Statement:
        text = "Formations have at most six vehicles, for computational reasons"
        parts = []
        for label in CLOSED:
            row = self._row(label, 1600.0)
            found = None if row is None else row.planning_p95_ms
            parts.append(f"`{label}` {MISSING if found is None else f'{found:.0f} ms'}")
        return Statement(text, "planning at 1600, p95: " + ", ".join(parts), OTHERWISE)


def _onset(first: float | None, below: float | None) -> str:
    """Return the volume from which on a method is congested, as far as it was measured."""
    if first is None:
        return MISSING if below is None else f"not up to {below:g}"
    return f"at {first:g}" + ("" if below is None else f", not yet at {below:g}")


def _series(texts: Sequence[str], known: Sequence[float]) -> str:
    """Return numbers at the paper's volumes; one word where there are none."""
    return f"{', '.join(texts)} s" if known else MISSING


def _all(kept: Sequence[bool | None]) -> str:
    """Return the verdict of a statement that holds if all findings agree; None: missing."""
    known = [one for one in kept if one is not None]
    if not known:
        return ""
    return _so_far(HOLDS if all(known) else FAILS, kept)


def _some(kept: Sequence[bool | None]) -> str:
    """Return the verdict of a statement that may hold for some readings of the rules only."""
    known = [one for one in kept if one is not None]
    return _so_far(DEPENDS, kept) if any(known) and not all(known) else _all(kept)


def _so_far(verdict: str, kept: Sequence[bool | None]) -> str:
    return f"so far: {verdict}" if None in kept else verdict
