"""Corridors drawn at random: no overlap, an agent for each vehicle, all at their destinations."""

from __future__ import annotations

from pathlib import Path

import pytest

from laneweave.launch.cli.corridor_command import corridor_tables
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.sim_bridge.corridors.sumo_corridor import read_corridor
from laneweave.sim_bridge.corridors.sumo_simulation import WHOLE
from support.drawn_corridors import draw_corridor, problems

IN_CI = 6


@pytest.mark.parametrize(
    "seed",
    [
        *(pytest.param(seed, marks=pytest.mark.more) for seed in range(IN_CI)),
        *(pytest.param(seed, marks=pytest.mark.full) for seed in range(IN_CI, 500)),
    ],
)
def test_all_get_where_their_routes_lead(tmp_path: Path, seed: int) -> None:
    drawn = draw_corridor(seed, tmp_path)
    try:
        found = read_corridor(drawn.config, drawn.name)
        tables = corridor_tables(found, drawn.config, WHOLE)
    except BadInputError as error:
        pytest.skip(f"refused: {error}")
    run = tmp_path / "run"
    outcome = SimulatedRun(parse_scenario(tables), run, show_progress=False).run()
    assert (*outcome.problems, *problems(drawn, run)) == (), drawn.text
