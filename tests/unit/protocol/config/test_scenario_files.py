"""Scenarios from files, tables and options; one readable line for everything that is wrong."""

from __future__ import annotations

import json
import math
from pathlib import Path

import attrs
import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.config.scenario_files import load_scenario, parse_scenario, to_tables
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import FormationSettings
from support.examples import examples
from support.refusals import refusal

FOLDER = Path(__file__).parents[4] / "scenarios"

# --- files ------------------------------------------------------------------------------------


def test_a_missing_file_or_a_folder_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.toml", Path("a\0b"), tmp_path):
        assert refusal(load_scenario, path).field == "file"


def test_values_that_toml_allows_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    for line, field in (
        ("seed = 0x" + "f" * 5000, "seed"),
        ("seed = 1979-05-27", "seed"),
        ("[road]\nlanes = nan", "road.lanes"),
        ("[demand]\nvolume_veh_per_lane_h = inf", "demand.volume_veh_per_lane_h"),
        ("[[road]]\nlanes = 3", "road"),
        ('"a\\nb" = 1', "a\nb"),
        ('[road]\n"a\\u001b[2J" = 1', "road.a\x1b[2J"),
    ):
        path.write_text(line, encoding="utf-8")
        assert refusal(load_scenario, path).field == field


def test_an_empty_file_is_the_default(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text("", encoding="utf-8")
    assert load_scenario(path) == Scenario()


def test_the_folder_is_found_from_anywhere(tmp_path: Path) -> None:
    path = tmp_path / "d.toml"
    path.write_text("[security]\nfolder = 'keys'\n")
    assert load_scenario(path).security.folder == str(tmp_path / "keys")
    path.write_text("[security]\nfolder = '/etc/keys'\n")
    assert load_scenario(path).security.folder == "/etc/keys"
    path.write_text("[security]\n")
    assert load_scenario(path).security.folder == str(tmp_path / "certs")


# --- an earlier name ---------------------------------------------------------------------------


def test_paper_stands_for_interlaced_blocks_of_columns_and_slots_of_four_seconds(
    tmp_path: Path,
) -> None:
    meant = FormationSettings(
        operation="formations",
        entry="interlaced",
        close="columns",
        cycle_s=4.0,
        targets="parallel",
        solver="tappa",
    )
    assert parse_scenario({"formation": {"operation": "paper"}}).formation == meant
    assert load_scenario(None, formation__operation="paper").formation == meant
    path = tmp_path / "x.toml"
    path.write_text('[formation]\noperation = "paper"\n', encoding="utf-8")
    assert load_scenario(path).formation == meant
    # What else is said counts.
    said = {"operation": "paper", "cycle_s": 6.0, "move_s": 5.0, "entry": "free"}
    assert parse_scenario({"formation": said}).formation == attrs.evolve(
        meant, cycle_s=6.0, move_s=5.0, entry="free"
    )
    assert (
        refusal(parse_scenario, {"formation": {"operation": "papers"}}).field
        == "formation.operation"
    )


def test_a_recording_of_the_paper_s_operation_under_its_earlier_name_is_read() -> None:
    tables = to_tables(load_scenario(FOLDER / "paper.toml"))
    earlier = {"operation": "paper", "cycle_s": 4.0, "move_s": 3.8, "block_columns": 4}
    kept = {
        name: value
        for name, value in tables["formation"].items()
        if name not in ("entry", "close", "max_columns")
    }
    tracked = {"horizon_ticks": 40, "always_solve": True}
    recording = tables | {"formation": kept | earlier, "tracking": tracked}
    recording["service"] = tables["service"] | {"cache_entries": 1024, "cache_s": 60.0}
    expected = load_scenario(FOLDER / "paper.toml")
    tracking = attrs.evolve(expected.tracking, horizon_ticks=40)
    assert parse_scenario(recording) == attrs.evolve(expected, tracking=tracking)


# --- round trip and overrides -----------------------------------------------------------------

SCENARIOS = st.builds(
    lambda lanes, volume, seed, mode, oblique, realm: attrs.evolve(
        Scenario(),
        seed=seed,
        road=attrs.evolve(Scenario().road, lanes=lanes),
        demand=attrs.evolve(
            Scenario().demand,
            volume_veh_per_lane_h=volume,
            lane_shares=tuple(float(lane + 1) for lane in range(lanes)),
        ),
        formation=attrs.evolve(Scenario().formation, mode=mode, weight_oblique=oblique),
        network=attrs.evolve(Scenario().network, realm=realm),
    ),
    st.integers(1, 8),
    st.floats(1, 3600),
    st.integers(0, 2**63 - 1),
    st.sampled_from((1, 2)),
    st.sampled_from((None, 0, 1)),
    st.text("abcXYZ019_.-", min_size=1, max_size=64),
)


@examples(50)
@given(SCENARIOS)
def test_tables_give_the_same_scenario_back(scenario: Scenario) -> None:
    tables = to_tables(scenario)
    assert parse_scenario(tables) == scenario
    assert parse_scenario(json.loads(json.dumps(tables))) == scenario


def test_overrides_replace_the_values_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text("seed = 5\n[demand]\nduration_s = 10.0\n", encoding="utf-8")
    scenario = load_scenario(
        path, seed=7, demand__volume_veh_per_lane_h=1600, runtime__coordinators=None
    )
    assert scenario.seed == 7
    assert scenario.demand.duration_s == 10.0
    assert scenario.demand.volume_veh_per_lane_h == 1600.0
    assert scenario.runtime.coordinators == Scenario().runtime.coordinators
    assert load_scenario(path, seed=None).seed == 5


@pytest.mark.parametrize(
    ("overrides", "field"),
    [
        ({"seed": -1}, "seed"),
        ({"demand__volume_veh_per_lane_h": math.nan}, "demand.volume_veh_per_lane_h"),
        ({"demand__speling": 1}, "demand.speling"),
        ({"speling__x": 1}, "speling"),
        ({"runtime__coordinators": "3"}, "runtime.coordinators"),
    ],
)
def test_a_wrong_override_is_refused_by_name(overrides: dict[str, object], field: str) -> None:
    assert refusal(load_scenario, None, **overrides).field == field


def test_an_override_of_a_table_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text("demand = 5", encoding="utf-8")
    assert refusal(load_scenario, path, demand__duration_s=1.0).field == "demand"


def refused_lines(folder: Path, text: str, **overrides: object) -> list[str]:
    """Return the errors of a scenario file."""
    path = folder / "x.toml"
    path.write_text(text, encoding="utf-8")
    return [
        str(one).replace(str(path), path.name)
        for one in refusal(load_scenario, path, **overrides).problems
    ]


def test_all_errors_of_a_file_are_reported_with_their_lines(tmp_path: Path) -> None:
    text = """\
seed = -1
[road]
lane = 2
lanes = 9
[[road.closures]]
from_m = 1.0
[formation]
operation = "roling"
"""
    assert [line.rpartition("; allowed")[0] for line in refused_lines(tmp_path, text)] == [
        "seed: got -1",
        "road.lane: got an unknown key",
        "road.lanes: got 9",
        "road.closures[0].lane: got no value",
        "formation.operation: got 'roling'",
    ]
    ends = [line.rpartition("; ")[2].rpartition("(")[2] for line in refused_lines(tmp_path, text)]
    assert ends == ["x.toml:1)", "x.toml:3)", "x.toml:4)", "x.toml:5)", "x.toml:8)"]


def test_contradictions_are_reported_at_once(tmp_path: Path) -> None:
    text = """\
[formation]
max_columns = 3
sort_in_s2 = true
close = "columns"
gap_m = 2.0
[network]
lease_s = 0.4
election_s = 0.6
heartbeat_s = 0.4
"""
    fields = [line.partition(":")[0] for line in refused_lines(tmp_path, text)]
    assert fields == [
        "formation.max_columns",
        "formation.sort_in_s2",
        "formation.gap_m",
        "network.lease_s",
        "network.election_s",
    ]


def test_a_value_that_an_override_replaces_is_checked(tmp_path: Path) -> None:
    (line,) = refused_lines(tmp_path, "[road]\nlanes = 3\n[demand]\nduration_s = 0\n")
    assert line.endswith("(x.toml:4)")
    again = refused_lines(tmp_path, "[demand]\nduration_s = 0\n", demand__duration_s=5.0)
    assert again == ["demand.duration_s: got 0.0; allowed: (0, 86400] (x.toml:2)"]


def test_an_invalid_override_has_no_line(tmp_path: Path) -> None:
    (line,) = refused_lines(tmp_path, "[demand]\nduration_s = 5\n", demand__duration_s=0.0)
    assert line == "demand.duration_s: got 0.0; allowed: (0, 86400]"
    # The file's value contradicts that of the option.
    (line,) = refused_lines(tmp_path, "[demand]\nlane_shares = [1, 1, 1]\n", road__lanes=2, seed=2)
    assert line.startswith("demand.lane_shares: got ")
    assert line.endswith("(x.toml:2)")
