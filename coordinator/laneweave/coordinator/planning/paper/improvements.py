"""What is added to Algorithms 1 and 2 of the paper; without any of it they are literal.

Each addition leaves the result exact. What each is worth is measured by
`benchmarks/planner_switches.py`; docs/PLANNING.md has the figures.
"""

from __future__ import annotations

import attrs


@attrs.frozen
class Improvements:
    """Switches of the additions.

    cutoff: CBSA of an assignment ends as soon as it cannot find a path set that costs less than
        C'* (`tappa`).
    cardinal: a node gets children for one of its conflicts, the one that raises their costs most,
        instead of for all of them (`splits`).
    bicliques: the constraints of its two children are sets of moves, and no path set satisfies
        both (`splits`). Has an effect with `cardinal` only.
    joint: when a tree grows large, A* over the cells of all vehicles goes on beside it (`joint`).
    """

    cutoff: bool = True
    cardinal: bool = True
    bicliques: bool = True
    joint: bool = True

    @classmethod
    def none(cls) -> Improvements:
        """Return the algorithms as the paper prints them."""
        return cls(**dict.fromkeys((field.name for field in attrs.fields(cls)), False))
