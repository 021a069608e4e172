"""The progress of a run: the bar, the pace, and the warning of a slow run."""

import pytest
from msgspec.structs import replace

from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.progress import PaceMeter, RunProgress, duration
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Name, RoadClock
from support.tables import for_each

CLOCK = RoadClock(10, 1.0, demanded=4, entered=2, on_road=2, left=0, ended=False)
VIEWS = (
    RoadView(),
    RoadView(clock=CLOCK),
    RoadView(clock=CLOCK, leader=Name("c1"), term=2),
    RoadView(clock=replace(CLOCK, tick=10**9, t_s=1e8)),
)


@pytest.mark.parametrize("show", [True, False])
def test_any_view_can_be_shown(capsys: pytest.CaptureFixture[str], show: bool) -> None:
    with RunProgress(Scenario(), show=show) as progress:
        for view in VIEWS:
            progress.show(view)
    captured = capsys.readouterr()
    assert captured.out == ""
    if not show:
        assert captured.err == ""


def measured(*paces: float, total_s: float = 400.0) -> PaceMeter:
    """Return the meter after 10 s of wall-clock time at each pace."""
    meter, road_s = PaceMeter(total_s), 0.0
    for tenth in range(100 * len(paces) + 1):
        meter.add(0.1 * tenth, road_s)
        road_s += 0.1 * paces[min(tenth // 100, len(paces) - 1)] if paces else 0.0
    return meter


def test_the_pace_is_that_of_the_last_seconds() -> None:
    assert PaceMeter(400.0).pace is None
    assert measured().pace is None
    assert measured(0.5).pace == pytest.approx(0.5)
    meter = measured(3.0, 0.5, 0.5)
    assert meter.pace == pytest.approx(0.5, abs=0.02)
    assert meter.left_s == pytest.approx((400.0 - 40.0) / 0.5, rel=0.05)
    assert measured(2.0, total_s=15.0).left_s == 0.0


@for_each(
    ("paces", "wanted_pace", "said"),
    [
        (
            (0.4,),
            1.0,
            "slower than real time: x0.40 at 4 s of road time, about 16 min left for 396 s",
        ),
        ((3.0, 0.5, 0.5), 1.0, "slower than real time: x0.50 at 40 s of road time, about 12 min"),
        ((0.4,), 0.4, ""),
        ((0.95,), 1.0, ""),
        ((0.2,), 1.0, ""),  # too early
        ((0.1, 0.1), 1.0, "slower than real time: x0.10 at 2 s of road time, about 66 min"),
        ((), 1.0, ""),
        ((0.0, 0.0), 1.0, ""),
    ],
)
def test_a_slow_run_is_reported(paces: tuple[float, ...], wanted_pace: float, said: str) -> None:
    slowness = measured(*paces).slowness(wanted_pace)
    assert slowness.startswith(said)
    assert bool(slowness) == bool(said)


def test_durations() -> None:
    assert [duration(one) for one in (0.4, 119.0, 120.0, 3000.0)] == [
        "0 s",
        "119 s",
        "2 min",
        "50 min",
    ]
