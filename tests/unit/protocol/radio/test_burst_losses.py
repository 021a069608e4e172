"""Bursts of losses: their share and duration."""

from __future__ import annotations

import random

import numpy as np
import pytest

from laneweave.protocol.radio import burst_losses
from laneweave.protocol.radio.burst_losses import BurstLosses

STEP_S = 0.05


def sampled(share: float, duration_s: float, count: int = 200_000) -> list[bool]:
    bursts = BurstLosses(share, duration_s, random.Random(7))
    return [bursts.is_bad("link", STEP_S * number) for number in range(count)]


@pytest.mark.parametrize(("share", "duration_s"), [(0.02, 0.5), (0.3, 2.0), (0.5, 1.0)])
def test_share_and_duration(share: float, duration_s: float) -> None:
    bad = np.array(sampled(share, duration_s))
    assert bad.mean() == pytest.approx(share, rel=0.1)
    begins = np.flatnonzero(bad[1:] & ~bad[:-1])
    ends = np.flatnonzero(~bad[1:] & bad[:-1])
    ends = ends[ends > begins[0]]
    durations_s = STEP_S * (ends - begins[: len(ends)])
    # Changes within a step are not seen, so that bursts look longer.
    assert durations_s.mean() == pytest.approx(duration_s, rel=0.12)


def test_no_bursts_need_no_draw() -> None:
    generator = random.Random(1)
    before = generator.getstate()
    assert not any(BurstLosses(0.0, 1.0, generator).is_bad("link", one) for one in range(100))
    assert generator.getstate() == before


def test_links_are_independent_and_forgotten_when_they_are_too_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(burst_losses, "MAX_LINKS", 100)
    bursts = BurstLosses(0.5, 1e9, random.Random(3))
    first = [bursts.is_bad(link, 0.0) for link in range(100)]
    assert 25 < sum(first) < 75
    assert [bursts.is_bad(link, 1.0) for link in range(100)] == first
    assert len({bursts.is_bad(1000 + link, 2.0) for link in range(50)}) == 2
    # The links 50 to 99 were used after the others, and are still known.
    assert [bursts.is_bad(link, 3.0) for link in range(50, 100)] == first[50:]


def test_time_that_goes_back_counts_as_the_same_time() -> None:
    bursts = BurstLosses(0.5, 1.0, random.Random(5))
    state = bursts.is_bad("link", 10.0)
    assert bursts.is_bad("link", 9.0) == state
