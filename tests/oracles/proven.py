"""Least costs that the mixed-integer programme has proven once.

    python tests/oracles/proven.py

proves them anew and writes `proven.json`. A request is known by its text: whoever changes how
requests are drawn, or one of them, gets its cost from the programme again. Whether what is written
is still what the programme proves, `make test-full` asks.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

if __name__ == "__main__":  # run as a program: as `pythonpath` in pyproject.toml
    sys.path.insert(0, str(Path(__file__).parents[1]))

from oracles import milp_oracle

FILE = Path(__file__).with_suffix(".json")
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
"""What was proven once is written down; the long programme proves all anew."""


def _key(request: dict[str, Any]) -> str:
    text = json.dumps(request, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def main() -> None:
    """Write the file."""
    from unit.coordinator.planning import test_against_milp, test_plans_with_geometry  # noqa: PLC0415

    requests = [*test_against_milp.compared(), *test_plans_with_geometry.compared()]
    costs = {_key(request): milp_oracle.optimal_cost(request) for request in requests}
    FILE.write_text(json.dumps(costs, indent=0, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
