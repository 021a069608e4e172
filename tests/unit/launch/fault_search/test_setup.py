"""The setup drawn from a seed is valid under every profile."""

import random
from collections import Counter
from itertools import pairwise

import pytest
from attrs import evolve

from laneweave.launch.fault_search.profiles import PROFILES, profiles_named
from laneweave.launch.fault_search.road.light_vehicle import Visit
from laneweave.launch.fault_search.road_setup import BLOCK_COLUMNS
from laneweave.launch.fault_search.setup import Setup
from laneweave.protocol.config.scenario_files import check_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.road_tables import Demand
from laneweave.protocol.wire.messages import ClosedFormation, Name
from support.variants import variants

EVERY = pytest.mark.parametrize(
    "name",
    [name for name, profile in PROFILES.items() if not (profile.rolling or profile.roadside)],
)
ROLLING = pytest.mark.parametrize(
    "name",
    [name for name, profile in PROFILES.items() if profile.rolling and not profile.roadside],
)
ROADSIDE = pytest.mark.parametrize(
    "name", variants([name for name, profile in PROFILES.items() if profile.roadside], 2)
)


def draw(name: str, count: int = 60) -> list[tuple[Setup, random.Random]]:
    rngs = [random.Random(seed) for seed in range(count)]
    return [(Setup.drawn(PROFILES[name], rng), rng) for rng in rngs]


def formation_of(setup: Setup, visit: Visit) -> ClosedFormation:
    """Return in whose columns a vehicle enters."""
    block = setup.scenario.lattice.block_of(visit.cell[0])
    (formation,) = (one for one in setup.formations if block in one.blocks)
    return formation


def columns_of(setup: Setup, formation: ClosedFormation) -> int:
    return len(formation.columns(setup.scenario.lattice))


def asks_for_too_much(setup: Setup, preferences: dict[Name, int]) -> bool:
    """Tell whether more vehicles of a formation want a lane than that has cells."""
    lanes = Counter((formation_of(setup, each), preferences[each.vehicle]) for each in setup.visits)
    return any(count > columns_of(setup, formation) for (formation, _), count in lanes.items())


@EVERY
def test_formations_follow_each_other_and_close_when_their_last_column_has_passed(
    name: str,
) -> None:
    lengths = set()
    for setup, _ in draw(name):
        lattice = setup.scenario.lattice
        columns = [one.columns(lattice) for one in setup.formations]
        for ahead, behind in pairwise(columns):
            assert behind[-1] < ahead[0]
        for one, own in zip(setup.formations, columns, strict=True):
            assert one.closed_s >= lattice.passing_time_s(own[0])
            lengths.add(len(own))
    assert BLOCK_COLUMNS in lengths
    assert (len(lengths) > 2) is (PROFILES[name].growing > 0)


@EVERY
def test_every_road_is_a_valid_scenario_with_room_for_all_and_some_stay(name: str) -> None:
    for setup, _ in draw(name):
        check_scenario(setup.scenario)
        cells = [visit.cell for visit in setup.visits]
        assert len(set(cells)) == len(cells)
        lattice = setup.scenario.lattice
        for visit in setup.visits:
            assert formation_of(setup, visit) in setup.formations
            assert visit.enters_s >= lattice.passing_time_s(visit.cell[0])
            assert visit.leaves_s is None or visit.leaves_s > visit.enters_s
        staying = {formation_of(setup, visit) for visit in setup.visits if not visit.leaves_s}
        assert staying == set(setup.formations)


@EVERY
def test_the_last_preferences_can_be_satisfied(name: str) -> None:
    for setup, rng in draw(name):
        preferences = setup.preferences(rng, last=True)
        if asks_for_too_much(setup, preferences):
            assert setup.scenario.formation.max_joined > 1
            assert setup.adjoin
            together = Counter(preferences.values())
            assert max(together.values()) <= sum(columns_of(setup, one) for one in setup.formations)


def test_lanes_are_crowded_now_and_then() -> None:
    crowded = 0
    for setup, rng in draw("joint"):
        crowded += asks_for_too_much(setup, setup.preferences(rng, last=True))
    assert crowded > 5


def test_profiles_draw_from_their_ranges() -> None:
    for name, profile in PROFILES.items():
        for setup, _ in draw(name):
            assert setup.lasting.conditions.loss in profile.lasting.loss
            assert setup.scenario.road.lanes in range(profile.lanes[0], profile.lanes[1] + 1)
            if not (profile.rolling or profile.roadside):
                assert len(setup.formations) in range(profile.blocks[0], profile.blocks[1] + 1)
    assert all(len(setup.visits) == 12 for setup, _ in draw("dense"))


def test_an_unknown_profile_is_refused() -> None:
    with pytest.raises(BadInputError, match="guided, mixed, calm, loss"):
        profiles_named("mild")


@ROLLING
def test_a_stretch_of_the_rolling_operation_has_one_owner_for_each_cell(name: str) -> None:
    for setup, rng in draw(name):
        check_scenario(setup.scenario)
        cells = [visit.cell for visit in setup.visits] + [grant.cell for grant in setup.grants]
        assert len(set(cells)) == len(cells)
        enters = {visit.vehicle: visit.enters_s for visit in setup.visits}
        for grant in setup.grants:
            assert grant.t_s >= enters[grant.owner]
        wanted = Counter(setup.preferences(rng, last=True).values())
        assert max(wanted.values()) <= setup.stretch_columns


@ROADSIDE
def test_the_roadside_admits_all_vehicles_in_turn(name: str) -> None:
    for setup, rng in draw(name, 20):
        if not setup.road.drawn.entrance:  # drawn ramps are shorter: bodies need not settle there
            # The volume has no effect: arrivals are drawn elsewhere.
            check_scenario(evolve(setup.scenario, demand=Demand(100.0)))
        lanes = setup.preferences(rng, last=False)
        roadside = setup.make_roadside(lanes, bridge=1)
        entered = [each for tick in range(1000) for each in roadside.admit(tick * 0.1)]
        assert {each.arrival.vehicle for each in entered} == set(lanes)
        for each in entered:
            assert each.arrival.preferred_lane == lanes[Name(each.arrival.vehicle)]


def test_dense_stretches_are_dense() -> None:
    for setup, _ in draw("rolling-dense"):
        room = setup.stretch_columns * setup.scenario.road.lanes
        assert 0.5 <= len(setup.visits) / room <= 0.9
