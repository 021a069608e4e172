"""The relative path map (paper, section `rpp`, table `rpm`).

One row per vehicle, one column per fixed time point: the cells in a column are occupied at the
same time, so conflicts can be read off two neighbouring columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs

from laneweave.protocol.lattice import Cell


@attrs.frozen
class RelativePathMap:
    """The cells of all vehicles at all fixed time points."""

    ids: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    @classmethod
    def padded(cls, ids: Sequence[str], paths: Sequence[Sequence[Cell]]) -> RelativePathMap:
        """Return a map of paths of different lengths, each padded with its last cell."""
        length = max((len(path) for path in paths), default=1)
        rows = (tuple(path) + (path[-1],) * (length - len(path)) for path in paths)
        return cls(tuple(ids), tuple(rows))

    @property
    def steps(self) -> int:
        """Return the number of steps between the first and the last time point."""
        return len(self.rows[0]) - 1 if self.rows else 0

    def cost(self) -> int:
        """Return the sum over vehicles of the number of steps until their final arrival."""
        return sum(final_arrival(row) for row in self.rows)

    def __str__(self) -> str:
        """Return the table as text; step 0 is the start, step k the time point after k moves."""
        cells = [[f"({c},{lane})" for c, lane in row] for row in self.rows]
        header = ["Vehicle ID", *(f"step {k}" for k in range(self.steps + 1))]
        # Ids are user input: replace characters that would break the table or control the terminal.
        ids = ["".join(c if c.isprintable() else "?" for c in name) for name in self.ids]
        table = [header, *([name, *row] for name, row in zip(ids, cells, strict=True))]
        widths = [max(len(line[k]) for line in table) for k in range(len(header))]
        return "\n".join(
            "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
            for line in table
        )


def final_arrival(path: Sequence[Cell]) -> int:
    """Return the number of steps until a path reaches its last cell for the last time."""
    steps = len(path) - 1
    while steps > 0 and path[steps - 1] == path[-1]:
        steps -= 1
    return steps
