"""Totals over reports are the same, however many senders there are."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import default_rng

from laneweave.protocol.summary import DurationMs
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.process_messages import Report
from laneweave.sim_bridge.recording import reports as reports_module
from laneweave.sim_bridge.recording.reports import MAX_SOLVE_MS, ReportTotals, SolveTimes
from laneweave.sim_bridge.recording.statistics import finite


@pytest.mark.parametrize("senders", [1, 2, 9, 100])
@pytest.mark.parametrize("processes", [1, 3, 100])
def test_final_reports_count_like_stored_ones(
    senders: int, processes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reports_module, "MAX_SENDERS", 8)
    rng, totals = default_rng(1), ReportTotals()
    published, solves, every = dict[int, int](), 0, list[float]()
    for number in range(senders):
        process = number % processes
        published[process] = published.get(process, 0) + 1 + number
        solve_ms = rng.uniform(0.02, 3.0, 50).astype("<f4")
        solves += len(solve_ms)
        every += solve_ms.tolist()
        report = Report(
            Name("agent"),
            Name(f"v{number}"),
            Name(f"p{process}"),
            published[process],
            solves=len(solve_ms),
            solve_ms=solve_ms.tobytes(),
        )
        for _ in range(1 + number % 2):
            totals.add(report)  # also twice
    assert totals.total("solves") == solves
    assert totals.total("published") == sum(published.values())
    assert totals.total("rejected") == 0
    assert totals.solve_ms() == totals.solve_ms()
    for percent, found in ((50, totals.solve_ms().p50), (99, totals.solve_ms().p99)):
        assert found == pytest.approx(float(np.percentile(every, percent)), abs=0.0011)


def test_reports_of_coordinators_are_never_final(monkeypatch: pytest.MonkeyPatch) -> None:
    """They report until the end, also if many agents do so between two of their reports."""
    monkeypatch.setattr(reports_module, "MAX_SENDERS", 8)
    totals = ReportTotals()
    totals.add(Report(Name("coordinator"), Name("c1"), Name("c1"), 1000, sidelink=5))
    for number in range(30):
        name = Name(f"v{number}")
        totals.add(Report(Name("agent"), name, name, 1))
    totals.add(Report(Name("coordinator"), Name("c1"), Name("c1"), 1010, sidelink=6))
    assert (totals.total("published"), totals.total("sidelink")) == (1040, 6)


def test_percentiles_interpolate_as_numpy_does() -> None:
    for values in ([2.0], [1.0, 3.0], [0.0, 0.001, 0.5, 0.5, 7.25], [5.0] * 10):
        times = SolveTimes()
        times.add(np.array(values, dtype="<f4").tobytes())
        for percent in (0, 25, 50, 95, 99, 100):
            expected = finite(float(np.percentile(values, percent)))
            assert times.percentile(percent) == pytest.approx(expected, abs=1e-9)


def test_very_long_solves_count_as_the_longest() -> None:
    times = SolveTimes()
    times.add(np.array([1e9, 3e38], dtype="<f4").tobytes())
    assert times.percentile(50) == MAX_SOLVE_MS


def test_without_reports_there_are_no_figures() -> None:
    assert ReportTotals().solve_ms() == DurationMs(p50=None, p99=None)
