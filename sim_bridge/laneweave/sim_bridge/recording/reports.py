"""Totals over the reports of all roles."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from copy import copy

import numpy as np
from attrs import define, field
from numpy.typing import NDArray

from laneweave.protocol.summary import DurationMs, Messages
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.process_messages import Report
from laneweave.sim_bridge.recording.statistics import finite

MAX_SENDERS = 256
"""Maximum number of agents whose newest reports are stored, and of their processes. An older report
is final: by then, the vehicle of the agent has left the road. Others report until the end."""
MAX_SOLVE_MS = 1000.0
"""Longer solves count as this long."""
_BINS_PER_MS = 1000
_AGENT = Name("agent")
_RADIO = ("sidelink", "sidelink_lost", "cellular", "cellular_lost")
_SUMMED = ("solves", "unusable", "osqp_solves", *_RADIO)
_OF_PROCESS = ("published", "rejected")


class SolveTimes:
    """Durations of solves, counted to 1 us, the resolution of the summary."""

    def __init__(self) -> None:
        """Begin without durations."""
        bins = int(MAX_SOLVE_MS * _BINS_PER_MS) + 1
        self._counts: NDArray[np.int64] = np.zeros(bins, dtype=np.int64)
        """Number of durations by whole microseconds."""

    def add(self, packed: bytes) -> None:
        """Count the valid durations [ms] of a report, packed as little-endian float32."""
        if len(packed) % 4:
            return
        values = np.frombuffer(packed, dtype="<f4").astype(np.float64)
        values = values[np.isfinite(values) & (values >= 0.0)]
        bins = np.rint(np.minimum(values, MAX_SOLVE_MS) * _BINS_PER_MS).astype(np.int64)
        np.add.at(self._counts, bins, 1)

    def __copy__(self) -> SolveTimes:
        """Return a copy that counts independently."""
        other = SolveTimes()
        other._counts += self._counts
        return other

    def percentile(self, percent: float) -> float | None:
        """Return a percentile [ms], interpolated as numpy does; None if there are no durations."""
        total = int(self._counts.sum())
        if not total:
            return None
        rank = percent / 100.0 * (total - 1)
        below, up_to = int(rank), np.cumsum(self._counts)
        low, high = (
            int(np.searchsorted(up_to, position, side="right"))
            for position in (below, min(below + 1, total - 1))
        )
        return finite((low + (high - low) * (rank - below)) / _BINS_PER_MS)


@define
class ReportTotals:
    """Sums over the newest report of each sender.

    `published` and `rejected` are counters of processes, whose senders all report them: their
    maximum counts for each process.
    """

    _newest: dict[tuple[Name, Name], Report] = field(factory=dict)
    """Newest report of each of the last senders, the one that reported last at the end."""
    _final: Counter[str] = field(factory=Counter)
    """Sums over all other senders and processes."""
    _processes: dict[Name, Counter[str]] = field(factory=dict)
    """Counters of the processes of these senders."""
    _kept_senders: set[tuple[Name, Name]] = field(factory=set)
    """Senders other than agents; their newest reports are stored until the end."""
    _kept_processes: set[Name] = field(factory=set)
    """Their processes."""
    _solve_times: SolveTimes = field(factory=SolveTimes)
    """Durations in reports that are final."""

    def add(self, report: Report) -> None:
        """Add a report, replacing the sender's earlier one."""
        sender = (report.role, report.name)
        self._newest.pop(sender, None)
        self._newest[sender] = report
        counters = Counter({name: getattr(report, name) for name in _OF_PROCESS})
        self._processes[report.process] = counters | self._processes.pop(report.process, counters)
        if report.role != _AGENT:
            self._kept_senders.add(sender)
            self._kept_processes.add(report.process)
        if len(self._newest) - len(self._kept_senders) > MAX_SENDERS:
            oldest = next(one for one in self._newest if one not in self._kept_senders)
            self._finish(self._newest.pop(oldest))
        if len(self._processes) - len(self._kept_processes) > MAX_SENDERS:
            first = next(one for one in self._processes if one not in self._kept_processes)
            self._final += self._processes.pop(first)

    def total(self, counter: str) -> int:
        """Return the sum of a counter over all senders, or over all processes."""
        return self._final[counter] + sum(self._not_final(counter))

    def messages(self, *, radio: bool) -> Messages:
        """Return the counts of messages; `radio`: whether the run has a radio."""
        return Messages(
            published=self.total("published"),
            dropped_by_faults=0,
            rejected=self.total("rejected"),
            **{name: self.total(name) if radio else None for name in _RADIO},
        )

    def solve_ms(self) -> DurationMs:
        """Return statistics of all durations."""
        times = copy(self._solve_times)
        for report in self._newest.values():
            times.add(report.solve_ms)
        return DurationMs(p50=times.percentile(50), p99=times.percentile(99))

    def _not_final(self, counter: str) -> Iterator[int]:
        if counter in _OF_PROCESS:
            yield from (counters[counter] for counters in self._processes.values())
        else:
            yield from (getattr(report, counter) for report in self._newest.values())

    def _finish(self, report: Report) -> None:
        self._final.update({name: getattr(report, name) for name in _SUMMED})
        self._solve_times.add(report.solve_ms)
