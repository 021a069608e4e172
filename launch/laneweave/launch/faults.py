"""Faults to inject into a run: a TOML file with one table for each.

[[kill]]
target = "leader"    # or the name of a coordinator
at_s = 60.0          # road time
"""

from __future__ import annotations

from pathlib import Path

import attrs
from attrs import field, frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario import read_toml, within
from laneweave.protocol.structuring import structure

LEADER = "leader"


@frozen
class Kill:
    """SIGKILL a coordinator process at a road time."""

    at_s: float = field(validator=within(0.0, 1e6))
    target: str = LEADER


@frozen
class Faults:
    """All faults of a run."""

    kill: tuple[Kill, ...] = ()

    def due(self, t_s: float) -> tuple[tuple[Kill, ...], Faults]:
        """Return the faults that are due and those that remain."""
        due = tuple(kill for kill in self.kill if kill.at_s <= t_s)
        remaining = tuple(kill for kill in self.kill if kill.at_s > t_s)
        return due, attrs.evolve(self, kill=remaining)

    def never_due(self) -> list[str]:
        """Return a line for each fault that is left over when a run has ended."""
        return [
            f"the run ended before {kill.target} was killed at {kill.at_s:g} s"
            for kill in self.kill
        ]


def load_faults(path: Path | None, coordinators: tuple[str, ...]) -> Faults:
    """Read a faults file; None means no faults.

    Raises:
        BadInputError: the file cannot be read, or a value is not acceptable.
    """
    if path is None:
        return Faults()
    faults = structure(read_toml(path), Faults)
    for index, kill in enumerate(faults.kill):
        if kill.target not in (LEADER, *coordinators):
            allowed = ", ".join((LEADER, *coordinators))
            raise BadInputError(f"kill[{index}].target", kill.target, allowed)
    return faults
