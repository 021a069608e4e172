"""Coverage of rules and guards, and the choice of profiles."""

from __future__ import annotations

from collections import Counter

from laneweave.launch.fault_search.coverage import Coverage, Rules, all_features
from laneweave.launch.fault_search.fault_run import FaultRun
from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.launch.fault_search.search import SearchResult, describe, search
from laneweave.launch.fault_search.story import Story


def test_every_row_and_guard_is_a_feature() -> None:
    rules, features = Rules(), list(all_features())
    rows = [row for book in (rules.vehicle, rules.leader, rules.transfer) for row in book.table]
    assert len(features) == sum(1 + len(row.guards) for row in rows)


def test_a_run_reaches_rules_of_its_operation() -> None:
    reached = FaultRun(Story.drawn(1, PROFILES["calm"])).run().features
    assert "vehicle V3 PLAN to taken" in reached
    assert "vehicle V5 tick (gate) to going: not all_are_ready" in reached
    assert reached <= set(all_features())
    assert not any(feature.startswith("transfer") for feature in reached)


def test_profiles_that_reach_what_is_rare_are_chosen_more_often() -> None:
    coverage = Coverage()
    assert coverage.choose(["a", "b"], 4, seed=0) == ["a", "b", "a", "b"]
    for _ in range(9):
        coverage.add("a", ["common"], cost=100)
    coverage.add("b", ["common", "rare"], cost=100)
    counts = Counter(coverage.choose(["a", "b"], 1000, seed=200))
    assert counts["b"] > 2 * counts["a"] > 0
    assert coverage.choose(["a", "b"], 50, seed=1) == coverage.choose(["a", "b"], 50, seed=1)


def test_what_is_never_reached_is_printed() -> None:
    result = SearchResult()
    features = list(dict.fromkeys(all_features()))
    result.coverage.add("a", features[1:], cost=1)
    lines = list(describe(result))
    assert f"{len(features) - 1} of {len(features)} rules and false guards reached" in lines
    assert f"  never: {features[0]}" in lines


def test_a_guided_search_uses_all_profiles_and_names_the_one_that_failed() -> None:
    result = search(range(3), [PROFILES["calm"], PROFILES["small"]], jobs=1)
    assert result.passed == 3
    assert set(result.coverage._by_profile) == {"calm", "small"}
