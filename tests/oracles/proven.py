"""Least costs that the mixed-integer programme has proven once, where that takes it long.

    python tests/oracles/proven.py

proves them anew and writes `proven.json`. A request is known by its text: whoever changes how
requests are drawn, or one of them, gets its cost from the programme again. Whether what is written
is still what the programme proves, `make test-full` asks.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

if __name__ == "__main__":  # run as a program: as `pythonpath` in pyproject.toml
    sys.path.insert(0, str(Path(__file__).parents[1]))

from oracles import milp_oracle

FILE = Path(__file__).with_suffix(".json")
LONG_S = 0.1
"""What takes the programme less is asked each time."""
KNOWN: dict[str, int | None] = json.loads(FILE.read_text(encoding="utf-8"))


def optimal_cost(request: dict[str, Any]) -> int | None:
    """The least cost over any number of steps; None: proven that there is no solution."""
    key = _key(request)
    return KNOWN[key] if key in KNOWN else milp_oracle.optimal_cost(request)


Oracle = Callable[[dict[str, Any]], int | None]

by_oracle = pytest.mark.parametrize(
    "oracle",
    [
        pytest.param(optimal_cost, id="once"),
        pytest.param(
            milp_oracle.optimal_cost, id="anew", marks=[pytest.mark.full, pytest.mark.timeout(1800)]
        ),
    ],
)
"""What takes the oracle long was proven once and written down; the long programme proves all."""


def _key(request: dict[str, Any]) -> str:
    text = json.dumps(request, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def prove(requests: Iterable[dict[str, Any]]) -> dict[str, int | None]:
    """Return the costs of those of the requests that take long."""
    costs = {}
    for request in requests:
        began_s = time.process_time()
        cost = milp_oracle.optimal_cost(request)
        if time.process_time() - began_s > LONG_S:
            costs[_key(request)] = cost
    return costs


def main() -> None:
    """Write the file."""
    from unit.coordinator.planning import test_against_milp, test_plans_with_geometry  # noqa: PLC0415

    costs = prove([*test_against_milp.compared(), *test_plans_with_geometry.compared()])
    FILE.write_text(json.dumps(costs, indent=0, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
