"""The progress bar: silent without a terminal, harmless before anything is known."""

import attrs
import pytest

from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.progress import RunProgress
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Name, RoadClock

CLOCK = RoadClock(10, 1.0, demanded=4, entered=2, on_road=2, left=0, ended=False)
VIEWS = (
    RoadView(),
    RoadView(clock=CLOCK),
    RoadView(clock=CLOCK, leader=Name("c1"), term=2),
    RoadView(clock=attrs.evolve(CLOCK, tick=10**9, t_s=1e8)),
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
