"""The paper's statements about its results (Section 5.2), compared with measurements.

The verdict of each statement is computed from the data.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

from attrs import frozen

from evaluation.comparisons import difference_of
from evaluation.evidence import Evidence
from evaluation.intervals import MIN_SEEDS, Verdict
from evaluation.markdown import HOLDS, MISSING, counted, markdown, number
from evaluation.points import PointRow
from evaluation.programme import SEEDS, VOLUMES, paper_bound, planned

PAPER_VOLUMES: Final = (1000.0, 1150.0, 1300.0, 1450.0, 1600.0)
"""Volumes of the paper's comparison, in vehicles/(lane h)."""
INTERPRETATIONS: Final = ("rule", "rule-net", "rule-yielding")
"""Labels of the interpretations of the paper's rules."""
OWN: Final = "paper-6"
"""Formation control with the paper's settings: at most six vehicles."""
CLOSED: Final = ("formations", OWN, "paper-12")
"""Labels with closed formations: the default and those of the paper."""
SUMO: Final = ("lc2013", "lc2013-4s", "lc2013-tuned", "sl2015-tuned")
"""Labels of SUMO's own lane changing."""
ALIKE_S: Final = 1.0
"""Maximum difference of the mean travel times of methods that are alike."""
STABLE: Final = 1.05
"""Maximum growth of stable travel times from 1000 to 1600."""
CONGESTED: Final = 1.25
"""A method is congested if its mean travel time exceeds this multiple of free flow."""
UNDISTURBED: Final = 0.9
"""Speeds are undisturbed if they are not below this share of v_F on average in any 50 m of road."""
CARRIED: Final = 0.97
"""Minimum ratio of throughput to volume at which the volume is carried."""
PAPER_STRETCH_M: Final = (500.0, 800.0)
STRETCH_ERROR_M: Final = 50.0
"""Tolerance: one bin of the road."""

FAILS, DEPENDS, NOT_JUDGED = "**does not hold**", "depends on the interpretation", ""


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
    few = any(len(row.runs) < len(SEEDS) for row in evidence.points)
    note = f"Not all points have {len(SEEDS)} seeds yet: see the table of runs."
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
        """Return the mean travel time [s]; inf: a run jammed; None: it is unknown."""
        row = self.evidence.by_key.get((label, volume))
        if row is None:
            return None
        return math.inf if row.jammed else row.mean("travel_s")

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
        text = "The travel time under the rules increases with the volume"
        parts: list[str] = []
        kept: list[bool | None] = []
        for label in INTERPRETATIONS:
            times = [self._travel_s(label, volume) for volume in PAPER_VOLUMES]
            known = [t_s for t_s in times if t_s is not None]
            texts = ["jam" if t_s == math.inf else number(t_s, 1) for t_s in times]
            parts.append(f"`{label}` {_series(texts, known)}")
            kept.append(known == sorted(known) if len(known) == len(times) else None)
        return Statement(text, "; ".join(parts), _all(kept))

    def _congested_from(self, label: str) -> tuple[float | None, float | None]:
        """Return the lowest congested volume, and the highest measured one below it.

        A volume at which runs have jammed is congested.
        """
        setting = self.evidence.setting
        times = {
            row.volume_veh_per_lane_h: travel_s
            for row in self.evidence.points
            if row.label == label
            and (travel_s := self._travel_s(label, row.volume_veh_per_lane_h)) is not None
        }
        if setting is None:
            return None, None
        max_s = CONGESTED * setting.free_flow_s
        first = min((volume for volume, t_s in times.items() if t_s > max_s), default=None)
        below = (volume for volume in times if first is None or volume < first)
        return first, max(below, default=None)

    def _rows(self, *labels: str) -> tuple[list[PointRow], list[None]]:
        """Return all points of labels, and None for each planned point that is missing."""
        rows = [
            self.evidence.by_key.get((label, volume))
            for label in labels
            for volume in VOLUMES
            if planned(label, volume)
        ]
        return [row for row in rows if row is not None], [None for row in rows if row is None]

    def _congestion(self) -> Statement:
        text = "Severe congestion under the rules at 1450 and 1600, none with formation control"
        parts: list[str] = []
        kept: list[bool | None] = []
        for label in (*INTERPRETATIONS, *CLOSED, "lc2013"):
            first, below = self._congested_from(label)
            if label in INTERPRETATIONS:
                known = self._travel_s(label, 1450.0) is not None
                kept.append(first is not None and first <= 1450.0 if known else None)
            parts.append(f"`{label}` {_onset(first, below)}")
        return Statement(text, "congested: " + "; ".join(parts), _some(kept))

    def _where(self) -> Statement:
        text = "The congestion is at 500 to 800 m"
        parts: list[str] = []
        kept: list[bool | None] = []
        for label in INTERPRETATIONS:
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
        traced = None if row is None else row.traced
        if setting is None or traced is None or traced.slowest_settled_mps is None:
            return Statement(text, MISSING, "")
        measured = (
            f"`{OWN}` at 1600: the mean speed is at least {number(traced.slowest_mps, 2)} m/s in "
            f"every 50 m of road, and {traced.slowest_settled_mps:.2f} m/s behind the place up to "
            "which vehicles settle"
        )
        kept = traced.slowest_settled_mps >= UNDISTURBED * setting.speed_mps
        return Statement(text, measured, _all([kept]))

    def _better(self) -> Statement:
        text = "Formation control is faster than the rules at these volumes"
        parts: list[str] = []
        kept: list[bool | None] = []
        too_few: set[float] = set()
        even: list[str] = []
        for label in INTERPRETATIONS:
            found = [
                difference_of(self.evidence, OWN, label, volume, "travel_s")
                for volume in PAPER_VOLUMES
            ]
            verdicts = [one.verdict if one is not None else Verdict.UNKNOWN for one in found]
            for volume, verdict in zip(PAPER_VOLUMES, verdicts, strict=True):
                if verdict is Verdict.UNKNOWN:
                    too_few.add(volume)
                elif verdict is Verdict.NONE:
                    even.append(f"not different from `{label}` at {volume:g}")
            texts = ["-" if one is None else f"{one.mean:+.1f}" for one in found]
            known = [one for one in found if one is not None]
            parts.append(f"`{OWN}` minus `{label}` {_series(texts, known)}")
            shown = all(one is Verdict.LESS for one in verdicts)
            kept.append(False if Verdict.MORE in verdicts else shown or None)
        if too_few:
            where = ", ".join(f"{volume:g}" for volume in sorted(too_few))
            parts.append(f"not judged: fewer than {MIN_SEEDS} common seeds at {where}")
        parts += even
        return Statement(text, "; ".join(parts), _some(kept))

    def _alike_below(self) -> Statement:
        text = "Below 1000 the methods are alike"
        parts: list[str] = []
        kept: list[bool | None] = []
        for volume in (500.0, 750.0):
            found = [
                difference_of(self.evidence, label, OWN, volume, "travel_s")
                for label in INTERPRETATIONS
            ]
            more_s = [one.mean for one in found if one is not None]
            texts = ["-" if one is None else f"{one.mean:+.1f}" for one in found]
            alike: bool | None = None
            if any(self._travel_s(label, volume) == math.inf for label in (OWN, *INTERPRETATIONS)):
                alike = False
            elif len(more_s) == len(found):
                alike = max(0.0, *more_s) - min(0.0, *more_s) <= ALIKE_S
            kept.append(alike)
            if any(one is None or one.bounds is None for one in found):
                kept.append(None)
            parts.append(f"at {volume:g}: {_series(texts, more_s)}" + (", alike" if alike else ""))
        whose = ", ".join(f"`{label}`" for label in INTERPRETATIONS)
        return Statement(text, f"{whose} minus `{OWN}` {'; '.join(parts)}", _all(kept))

    def _bound(self) -> Statement:
        row, setting = self._row("paper-12", 1750.0), self.evidence.setting
        text = "At most 3600 v_F / 2 d_F can be carried"
        rate = None if row is None else row.mean("throughput_veh_per_lane_h")
        if rate is None or setting is None:
            return Statement(text, MISSING, "")
        bound = paper_bound(setting.speed_mps, setting.pitch_m)
        text += f", here {bound:g} veh/(lane h)"
        measured = f"`paper-12` carries {rate:.0f} of 1750"
        kept: list[bool | None] = [rate >= CARRIED * 1750.0, None]
        over = self._row("paper-12", 2000.0)
        if over is not None and (most := over.mean("throughput_veh_per_lane_h")) is not None:
            measured += f" and {most:.0f} of 2000"
            kept[1] = most <= bound
        beyond = [
            f"`{label}` carries {carried:.0f} of {volume:g}"
            for label, volume in (("formations", 2000.0), ("rolling", 2400.0))
            if (found := self._row(label, volume)) is not None
            and (carried := found.mean("throughput_veh_per_lane_h") or 0.0) > bound
        ]
        if beyond:
            measured += "; the bound applies to interlaced entry, not to the lattice: "
            measured += ", ".join(beyond)
        return Statement(text, measured, _all(kept))

    def _safe(self) -> Statement:
        text = "Formation control plans paths without collisions to the preferred lanes"
        rows, missing = self._rows(*CLOSED)
        if not rows:
            return Statement(text, MISSING, "")
        off, vehicles = _off(rows)
        overlaps = sum(row.overlaps for row in rows)
        measured = f"{overlaps} overlaps, {off} of {vehicles:,} vehicles not in their lane"
        kept = not overlaps and not off and not any(row.unfinished for row in rows)
        return Statement(text, measured + _unfinished_text(rows), _all([kept, *missing]))

    def _rules_complete(self) -> Statement:
        text = "The rules bring all vehicles to their preferred lanes in any traffic"
        rows, missing = self._rows(*INTERPRETATIONS)
        if not rows:
            return Statement(text, MISSING, "")
        off, vehicles = _off(rows)
        measured = f"{off} of {vehicles:,} did not reach their lane{_unfinished_text(rows)}"
        complete = not off and not any(row.unfinished for row in rows)
        return Statement(text, measured, _all([complete, *missing]))

    def _sumo_blocks(self) -> Statement:
        text = "SUMO's own lane changing may block itself at the end of the road"
        parts: list[str] = []
        blocked: list[bool | None] = []
        for label in SUMO:
            rows, missing = self._rows(label)
            off, vehicles = _off(rows)
            if rows:
                blocked.append(off > 0 or any(row.jammed for row in rows))
            blocked.extend(missing)
            found = f"{off} of {vehicles:,} did not reach their lane{_unfinished_text(rows)}"
            parts.append(f"`{label}`: {found if rows else MISSING}")
        known = [one for one in blocked if one is not None]
        verdict = HOLDS if any(known) else _provisional("not observed", blocked) if known else ""
        return Statement(text, "; ".join(parts), verdict)

    def _six(self) -> Statement:
        text = "Formations have at most six vehicles, for computational reasons"
        parts = []
        for label in CLOSED:
            row = self._row(label, 1600.0)
            found = None if row is None else row.highest("planning_p95_ms")
            parts.append(f"`{label}` {MISSING if found is None else f'{found:.0f} ms'}")
        return Statement(text, "planning at 1600, p95: " + ", ".join(parts), NOT_JUDGED)


def _off(rows: Sequence[PointRow]) -> tuple[int, int]:
    """Return how many vehicles did not reach their lane, and how many there were."""
    demanded = sum(row.total("demanded") for row in rows)
    return demanded - sum(row.total("on_preferred_lane") for row in rows), demanded


def _unfinished_text(rows: Sequence[PointRow]) -> str:
    """Return as text which runs jammed or crashed; empty if none did."""
    parts = [
        f"{counted(count, 'run')} of `{row.label}` at {row.volume_veh_per_lane_h:g} {what}"
        for row in rows
        for count, what in ((row.jammed, "jammed"), (row.unfinished - row.jammed, "crashed"))
        if count
    ]
    return "".join(f", {part}" for part in parts)


def _onset(first: float | None, below: float | None) -> str:
    """Return as text the lowest congested volume, and the highest measured one below it."""
    if first is None:
        return MISSING if below is None else f"not up to {below:g}"
    return f"at {first:g}" + ("" if below is None else f", not yet at {below:g}")


def _series(texts: Sequence[str], known: Sequence[object]) -> str:
    """Return numbers at the paper's volumes as text, or `MISSING`."""
    return f"{', '.join(texts)} s" if known else MISSING


def _all(kept: Sequence[bool | None]) -> str:
    """Return the verdict of a statement that holds if all findings (None: missing) are true."""
    known = [one for one in kept if one is not None]
    if not known:
        return ""
    return _provisional(HOLDS if all(known) else FAILS, kept)


def _some(kept: Sequence[bool | None]) -> str:
    """Return the verdict of a statement that may hold for some interpretations only."""
    known = [one for one in kept if one is not None]
    return _provisional(DEPENDS, kept) if any(known) and not all(known) else _all(kept)


def _provisional(verdict: str, kept: Sequence[bool | None]) -> str:
    return f"so far: {verdict}" if None in kept else verdict
