"""Faults that last throughout the fault phase of a run: message faults, planning, clocks."""

from __future__ import annotations

import random
from collections import Counter

from attrs import frozen

from laneweave.launch.fault_search.profiles import Profile
from laneweave.protocol.transports.simulated.virtual_time import Conditions

LEASE_S = 0.5
COMPUTE_S = 0.05
CLOCK_OFFSET_S = 0.05
CLOCK_DRIFT = 0.05
HEALTHY = Conditions(lease_s=LEASE_S, compute_s=COMPUTE_S)
"""Conditions after the fault phase."""


@frozen
class LastingFaults:
    """Faults throughout the fault phase of a run."""

    conditions: Conditions = HEALTHY
    command_loss: float = 0.0
    """Additional loss of SENSE and COMMAND messages."""
    late_commands: float = 0.0
    """Share of commands whose motion a controller refuses, as if they came too late."""
    slow_moves: float = 0.0
    """Share of motions that last up to three slots."""
    wrong_clocks: bool = False
    fault_s: float = 10.0
    """Duration of the fault phase."""

    @classmethod
    def drawn(cls, profile: Profile, rng: random.Random) -> LastingFaults:
        """Draw faults from a profile."""
        ranges = profile.lasting
        return cls(
            conditions=Conditions(
                loss=rng.choice(ranges.loss),
                duplication=rng.choice(ranges.duplication),
                jitter_s=rng.choice(ranges.jitter_s),
                lease_s=LEASE_S,
                compute_s=COMPUTE_S,
                compute_jitter_s=rng.choice(ranges.compute_jitter_s),
                compute_failure=rng.choice(ranges.compute_failure),
            ),
            command_loss=rng.choice(ranges.command_loss),
            late_commands=rng.choice(ranges.late_commands),
            slow_moves=rng.choice(ranges.slow_moves),
            wrong_clocks=rng.random() < ranges.wrong_clocks,
            fault_s=rng.uniform(*profile.fault_s),
        )

    def kinds(self) -> Counter[str]:
        """Return the kinds of faults that are present, each with count 1."""
        conditions = self.conditions
        present = {
            "loss": conditions.loss,
            "duplication": conditions.duplication,
            "reordering": conditions.jitter_s > 0.01,
            "late-planning": conditions.compute_jitter_s,
            "failing-planning": conditions.compute_failure,
            "lost-commands": self.command_loss,
            "late-commands": self.late_commands,
            "slow-moves": self.slow_moves,
            "wrong-clocks": self.wrong_clocks,
        }
        return Counter(kind for kind, is_present in present.items() if is_present)
