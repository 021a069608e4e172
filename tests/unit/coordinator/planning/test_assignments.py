"""All assignments, in order, compared with sorting all of them."""

import itertools
import time

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.planning.paper.assignments import (
    Assignment,
    BoolMatrix,
    IntMatrix,
    assignments,
)
from support.examples import examples


@st.composite
def matrices(draw: st.DrawFn) -> tuple[IntMatrix, BoolMatrix]:
    vehicles = draw(st.integers(1, 4))
    targets = draw(st.integers(1, 5))
    size = vehicles * targets
    costs = draw(st.lists(st.integers(0, 4), min_size=size, max_size=size))
    allowed = draw(st.lists(st.booleans() | st.just(True), min_size=size, max_size=size))
    shape = vehicles, targets
    return np.array(costs).reshape(shape), np.array(allowed).reshape(shape)


def _sorted(costs: IntMatrix, allowed: BoolMatrix) -> list[Assignment]:
    vehicles, targets = costs.shape
    found = [
        Assignment(vector, int(sum(costs[i, j] for i, j in enumerate(vector))))
        for vector in itertools.permutations(range(targets), vehicles)
        if all(allowed[i, j] for i, j in enumerate(vector))
    ]
    return sorted(found, key=lambda a: (a.cost, a.targets))


@examples(300)
@given(matrices())
def test_order_is_by_cost_then_by_vector_and_complete(case: tuple[IntMatrix, BoolMatrix]) -> None:
    assert list(assignments(*case)) == _sorted(*case)


def test_assignments_are_made_one_at_a_time() -> None:
    costs = np.arange(400, dtype=np.int64).reshape(20, 20) % 7
    stream = assignments(costs, np.ones((20, 20), np.bool_))
    started = time.process_time()
    first = list(itertools.islice(stream, 30))
    assert time.process_time() - started < 2
    assert [a.cost for a in first] == sorted(a.cost for a in first)
    assert len({a.targets for a in first}) == 30
