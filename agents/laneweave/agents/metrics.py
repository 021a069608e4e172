"""Metrics of an agent process."""

from __future__ import annotations

from typing import ClassVar

from attrs import field, frozen

from laneweave.protocol.runtime.metrics import metric


@frozen
class AgentMetrics:
    """Counters of the vehicles of one process."""

    ABOUT: ClassVar[str] = "agent"

    vehicles: int = field(metadata=metric("Vehicles that this process drives or waits for"))
    vehicles_in_charge: int = field(
        metadata=metric("Vehicles on the road of which this process is in charge")
    )
    solves_total: int = field(metadata=metric("Trajectories that were tracked, one for each tick"))
    unusable_total: int = field(metadata=metric("Solutions of the tracker that could not be used"))
