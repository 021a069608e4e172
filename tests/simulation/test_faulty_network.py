"""Random search: no two vehicles ever claim one cell, and all arrive once the network is whole.

Every seed draws loss, duplication, delays, slow motions, kills, pauses, crashes and cuts
(`world.Faults`). A failure replays from its seed: `World(seed).run()`.

`mutants` shows that the search can fail: each of them takes one rule away.
"""

from __future__ import annotations

import pytest

from simulation import mutants
from simulation.mutants import Mutant
from simulation.world import FAULTS_END_S, LAST_WISHES_S, SLOT_S, Faults, World

CALM = Faults(loss=0.0, duplication=0.0, jitter_s=0.003, slow_moves=0.0, events=0)
ROUGH = Faults(loss=0.3, duplication=0.3, jitter_s=0.3, slow_moves=0.5, events=4)
BATCH = 20


def search(first_seed: int, count: int) -> None:
    motions = 0
    for seed in range(first_seed, first_seed + count):
        world = World(seed)
        outcome = world.run()
        assert not outcome.overlaps, f"seed {seed}, {world.faults}"
        assert not outcome.astray, f"seed {seed}, {world.faults}"
        motions += outcome.motions
    assert motions > 3 * count  # the search is not idle


@pytest.mark.parametrize("first_seed", range(0, 100, BATCH))
def test_no_overlap_and_everybody_arrives(first_seed: int) -> None:
    search(first_seed, BATCH)


@pytest.mark.full
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("first_seed", range(10_000, 12_000, 100))
def test_no_overlap_and_everybody_arrives_long(first_seed: int) -> None:
    search(first_seed, 100)


@pytest.mark.parametrize("seed", range(3))
def test_undisturbed_everybody_arrives_without_delay(seed: int) -> None:
    outcome = World(seed, CALM).run()
    assert not outcome.overlaps
    # The last wishes, one census, the margin of a new plan, and the steps.
    assert outcome.healed_s + FAULTS_END_S < LAST_WISHES_S + 1.0 + 0.5 + 6 * SLOT_S


def test_equal_seeds_give_equal_runs() -> None:
    assert World(7, ROUGH).run() == World(7, ROUGH).run()


# `mutants.no_promise_check` is not in this list: its collision needs a plan and a state that are
# both older than a whole later plan. The story `late_duplicate_plan` has it.
MUTANTS: tuple[Mutant, ...] = (
    mutants.no_gate,
    mutants.timetable_only,
    mutants.needs_one_less,
    mutants.ready_while_moving,
    mutants.foreign_motion_counts,
    mutants.any_ballot_releases,
)


@pytest.mark.parametrize("plant", MUTANTS)
def test_planted_bug_is_caught(plant: Mutant, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(monkeypatch)
    assert any(World(seed, ROUGH).run().overlaps for seed in range(60))
