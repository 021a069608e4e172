"""The conflict table computed from geometry."""

from functools import cache
from itertools import product
from random import Random

import attrs
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from laneweave.agents.driving.trajectory import move_profile
from laneweave.coordinator.planning.conflict_kinds import (
    MAX_OFFSET,
    PAPER_KINDS,
    ConflictModel,
    Move,
    Pair,
)
from laneweave.coordinator.planning.geometry import conflict_table as clearances
from laneweave.coordinator.planning.geometry.conflict_table import (
    conflict_table,
    min_clearances,
    pairs_closer_than,
)
from laneweave.coordinator.planning.geometry.swept_bodies import (
    BodyGeometry,
    Floats,
    minimum_jerk_path,
    outline,
)
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell, Mode, displacements, footprint
from laneweave.protocol.scenario.fields import Scenario
from oracles.moving_bodies import Bodies, least_gap_m
from support.examples import examples
from support.tables import for_each
from support.variants import variants

NEAR = range(-MAX_OFFSET, MAX_OFFSET + 1)
STEPS = displacements(2)
ANY_DELAY = BodyGeometry()
HALF_A_SECOND = BodyGeometry(lateness_s=0.5)


def moves(pair: Pair) -> tuple[Move, Move]:
    offset, a, b = pair
    return ((0, 0), a), (offset, (offset[0] + b[0], offset[1] + b[1]))


def every_pair(mode: Mode = 2) -> list[Pair]:
    """All pairs of moves from different cells that are not far apart."""
    steps = displacements(mode)
    offsets = [offset for offset in product(NEAR, NEAR) if offset != (0, 0)]
    return list(product(offsets, steps, steps))


def footprints_meet(pair: Pair) -> bool:
    a, b = moves(pair)
    return not footprint(*a).isdisjoint(footprint(*b))


@cache
def actual_paths() -> dict[Cell, Floats]:
    """The trajectories of agents in the default scenario."""
    return {
        step: move_profile(Scenario(), Scenario().vehicle, *step).states[:, [0, 3]]
        for step in STEPS
    }


@st.composite
def geometries(draw: st.DrawFn) -> BodyGeometry:
    """Draw consistent lengths, times and clearances, some of them close to the limits."""
    numbers = {
        "length_m": draw(st.floats(3.0, 12.0)),
        "width_m": draw(st.floats(1.0, 2.5)),
        "move_s": draw(st.floats(2.0, 8.0)),
        "profile_error_along_m": draw(st.floats(0.0, 1.0)),
        "profile_error_across_m": draw(st.floats(0.0, 0.2)),
    }
    pitch_m = numbers["length_m"] + draw(st.floats(4.0, 20.0))
    lane_width_m = numbers["width_m"] + draw(st.floats(0.6, 2.0))
    numbers |= {"pitch_m": pitch_m, "lane_width_m": lane_width_m}
    numbers["slot_s"] = numbers["move_s"] + draw(st.floats(0.0, 1.0))
    numbers["speed_mps"] = pitch_m / numbers["move_s"] * draw(st.floats(2.2, 6.0))
    shares = st.sampled_from((0.0, 0.3, 0.6, 0.8, 0.95))
    numbers["clearance_along_m"] = (pitch_m - numbers["length_m"]) * draw(shares)
    numbers["clearance_across_m"] = (lane_width_m - numbers["width_m"]) * draw(shares)
    lateness_s = draw(st.none() | st.floats(0.0, 1.0))
    try:
        return BodyGeometry(**numbers, lateness_s=lateness_s)
    except BadInputError:
        assume(False)
        raise


# --------------------------------------------------------------------- the table at any delay


@for_each("mode", [1, 2])
@for_each("kind", PAPER_KINDS)
def test_at_any_delay_it_contains_the_kinds_of_the_paper(mode: Mode, kind: str) -> None:
    model = ConflictModel([kind])
    named = {pair for pair in every_pair(mode) if model.kind(*moves(pair)) is not None}
    assert named or (mode == 1 and kind in ("special-2", "special-3", "special-4"))
    assert named <= conflict_table(ANY_DELAY)


def test_the_kinds_of_the_paper_overlook_pairs_of_oblique_moves_only() -> None:
    """All other pairs that the table forbids at any delay are also conflicts of the paper."""
    model = ConflictModel(PAPER_KINDS)
    named = {pair for pair in every_pair() if model.kind(*moves(pair)) is not None}
    overlooked = conflict_table(ANY_DELAY) & set(every_pair()) - named
    assert (len(named), len(overlooked)) == (280, 64)
    steps = [(b[0] - a[0], b[1] - a[1]) for pair in overlooked for a, b in moves(pair)]
    assert all(column and lane for column, lane in steps)
    assert ((-1, -2), (-1, -1), (1, 1)) in overlooked & conflict_table(BodyGeometry(lateness_s=0.0))


def test_at_any_delay_it_is_footprints_except_obliques_that_share_a_corner() -> None:
    meeting = {pair for pair in every_pair() if footprints_meet(pair)}
    allowed = meeting - conflict_table(ANY_DELAY)
    assert len(meeting) == 360
    assert len(allowed) == 16
    for pair in allowed:
        a, b = moves(pair)
        (shared,) = footprint(*a) & footprint(*b)
        assert shared not in (*a, *b), "a corner of both"
    assert not {pair for pair in conflict_table(ANY_DELAY) if pair[0] != (0, 0)} - meeting


def test_in_mode_1_it_is_footprints() -> None:
    meeting = {pair for pair in every_pair(1) if footprints_meet(pair)}
    assert conflict_table(ANY_DELAY) & set(every_pair(1)) == meeting


# ----------------------------------------------------------------------------------- lateness


@pytest.mark.parametrize("along", [-1, 1])
def test_trains_are_allowed_with_limited_lateness(along: int) -> None:
    train: Pair = ((1, 0), (along, 0), (along, 0))
    assert train not in conflict_table(HALF_A_SECOND)
    assert train in conflict_table(BodyGeometry(lateness_s=0.8))
    assert train in conflict_table(attrs.evolve(HALF_A_SECOND, clearance_along_m=6.0))
    assert train in conflict_table(ANY_DELAY)


@pytest.mark.parametrize("lateness_s", [0.0, 0.5])
@pytest.mark.parametrize("mode", [1, 2])
def test_waiting_in_a_crossed_cell_is_a_conflict(mode: Mode, lateness_s: float) -> None:
    table = conflict_table(BodyGeometry(lateness_s=lateness_s))
    node = ConflictModel(["node", "edge"])
    assert {pair for pair in every_pair(mode) if node.kind(*moves(pair))} <= table
    same_cell = {((0, 0), a, b) for a, b in product(displacements(mode), repeat=2)}
    assert same_cell <= table


# ------------------------------------------------------------------------------ what is proven


@pytest.mark.slow
@examples(20)
@given(geometries())
def test_the_table_is_symmetric_and_has_no_disjoint_footprints(geometry: BodyGeometry) -> None:
    """Those are separated by a column or by a lane."""
    table = conflict_table(geometry)
    for (column, lane), a, b in table:
        assert footprints_meet(((column, lane), a, b))
        assert ((-column, -lane), b, a) in table
        assert ((column, -lane), (a[0], -a[1]), (b[0], -b[1])) in table


@pytest.mark.parametrize("geometry", [ANY_DELAY, HALF_A_SECOND, BodyGeometry(lateness_s=0.0)])
def test_backwards_it_forbids_the_same_or_more(geometry: BodyGeometry) -> None:
    """Bodies turn more if they fall back while they change lanes."""
    table = conflict_table(geometry)
    mirrored = {((-c, lane), (-a[0], a[1]), (-b[0], b[1])) for (c, lane), a, b in table}
    assert {pair for pair in mirrored if pair[1][0] <= 0 and pair[2][0] <= 0} <= table
    assert (table == mirrored) == (geometry != HALF_A_SECOND)


@pytest.mark.slow
@examples(15)
@given(geometries(), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 0.5))
@pytest.mark.more
def test_more_clearance_or_more_lateness_removes_nothing(
    geometry: BodyGeometry, along: float, across: float, late_s: float
) -> None:
    late = geometry.lateness_s
    try:
        stricter = attrs.evolve(
            geometry,
            clearance_along_m=geometry.clearance_along_m + along,
            clearance_across_m=geometry.clearance_across_m + across,
            lateness_s=None if late is None else late + late_s,
        )
    except BadInputError:
        stricter = attrs.evolve(geometry, lateness_s=None)
    assert conflict_table(geometry) <= conflict_table(stricter)
    assert conflict_table(geometry) <= conflict_table(attrs.evolve(geometry, lateness_s=None))


# -------------------------------------------------------------------------- against simulation


@pytest.mark.more
@pytest.mark.slow
@examples(12)
@given(geometries(), st.integers(0, 10**6))
def test_it_contains_what_simulated_bodies_do(geometry: BodyGeometry, seed: int) -> None:
    """Forbidden pairs are too close with slightly larger clearances."""
    bodies = Bodies(**attrs.asdict(geometry))
    table = conflict_table(geometry)
    slack_m = 0.1 + 2.0 * 1.875 * geometry.pitch_m / geometry.move_s * geometry.move_s / 100
    for pair in Random(seed).sample(every_pair(), 300):
        if least_gap_m(bodies, *pair) < geometry.clearance_along_m:
            assert pair in table
        elif pair in table:
            nearly_m = least_gap_m(bodies, *pair, more_across_m=0.15)
            assert nearly_m < geometry.clearance_along_m + slack_m, pair


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lateness_s", "parts"),
    variants(product((0.3, None, 0.0, 0.7), (clearances.PARTS, 3, 8)), count=2),
)
def test_clearances_are_never_overestimated(
    parts: int, lateness_s: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With coarser parts they are smaller."""
    monkeypatch.setattr(clearances, "PARTS", parts)
    geometry, bodies = BodyGeometry(lateness_s=lateness_s), Bodies(lateness_s=lateness_s)
    found = min_clearances(geometry)
    for (column, lane), a, b in every_pair():
        least_m = found[column + 3, lane + 3, STEPS.index(a), STEPS.index(b)]
        assert least_m <= least_gap_m(bodies, (column, lane), a, b) + 1e-6


@pytest.mark.parametrize(
    ("lateness_s", "more", "more_with_errors"),
    [(None, 0, 0), (0.0, 0, 8), (0.2, 0, 0), (0.5, 0, 16)],
)
def test_the_table_contains_that_of_driven_motions_and_little_more(
    lateness_s: float | None, more: int, more_with_errors: int
) -> None:
    """They accelerate less and later; the profile errors of the geometry make up for it."""
    geometry = BodyGeometry(lateness_s=lateness_s)
    exact = attrs.evolve(geometry, profile_error_along_m=0.0, profile_error_across_m=0.0)
    driven = pairs_closer_than(exact, actual_paths())
    assert (min_clearances(exact, actual_paths()) >= min_clearances(geometry)).all()
    assert driven <= conflict_table(exact) & conflict_table(geometry)
    assert len(conflict_table(exact) - driven) == more
    assert len(conflict_table(geometry) - driven) == more_with_errors
    of_mode_1 = {step: path for step, path in actual_paths().items() if 0 in step}
    straight = pairs_closer_than(exact, of_mode_1)
    assert straight == {pair for pair in driven if 0 in pair[1] and 0 in pair[2]}


def test_profile_errors_cover_the_profiles_of_the_default_scenario() -> None:
    geometry = BodyGeometry()
    times = np.linspace(0.0, 1.0, 2000)

    def edges(paths: dict[Cell, Floats]) -> Floats:
        found = []
        for step in STEPS:
            outlined = geometry.outline(paths[step])
            known = np.linspace(0.0, 1.0, len(outlined))
            found.append([np.interp(times, known, edge) for edge in outlined.T])
        return np.array(found)

    more = edges(actual_paths()) - edges(geometry.paths())
    least, most = more.min(axis=(0, 2)), more.max(axis=(0, 2))
    along_m, across_m = most[1] - least[0], most[3] - least[2]
    assert 0.5 < along_m <= geometry.profile_error_along_m
    assert 0.02 < across_m <= geometry.profile_error_across_m


# ------------------------------------------------------------------------------------- bodies


@pytest.mark.parametrize("displacement", [(1, 0), (0, 1), (-1, 1)])
def test_outlines_hold_between_samples(displacement: Cell) -> None:
    """Boxes of a path with few samples contain those of the same path with many."""
    along_m, across_m = 15.0 * displacement[0], 3.5 * displacement[1]
    fine = outline(minimum_jerk_path(along_m, across_m, 760), 3.8, 15.0, 5.0, 1.8)
    coarse = outline(minimum_jerk_path(along_m, across_m, 38), 3.8, 15.0, 5.0, 1.8)
    shares, known = np.linspace(0.0, 1.0, len(fine)), np.linspace(0.0, 1.0, len(coarse))
    rear, front, right, left = (np.interp(shares, known, edge) for edge in coarse.T)
    assert (rear <= fine[:, 0] + 1e-3).all()
    assert (front >= fine[:, 1] - 1e-3).all()
    assert (right <= fine[:, 2] + 1e-3).all()
    assert (left >= fine[:, 3] - 1e-3).all()


def test_conflicts_beyond_the_maximum_offset_are_refused() -> None:
    paths = {(0, 0): np.zeros((5, 2)), (1, 0): 45.0 * np.linspace(0, 1, 5)[:, None] * [1.0, 0.0]}
    with pytest.raises(ValueError, match="3, 0"):
        pairs_closer_than(BodyGeometry(), paths)


def test_a_model_with_a_table_needs_geometric() -> None:
    with pytest.raises(ValueError, match="without geometric"):
        ConflictModel(["node"], conflict_table(BodyGeometry()))


def test_a_model_with_a_table_uses_it() -> None:
    model = ConflictModel(["geometric"], conflict_table(HALF_A_SECOND))
    for pair in every_pair():
        assert (model.kind(*moves(pair)) == "geometric") == (pair in conflict_table(HALF_A_SECOND))
    train = moves(((1, 0), (1, 0), (1, 0)))
    assert model.kind(*train) is None
    assert (
        ConflictModel(["special-1", "geometric"], conflict_table(HALF_A_SECOND)).kind(*train)
        == "special-1"
    )
