"""Metrics of a bridge."""

from __future__ import annotations

from typing import ClassVar

from attrs import field, frozen

from laneweave.protocol.runtime.metrics import metric


@frozen
class BridgeMetrics:
    """Counters of the road."""

    ABOUT: ClassVar[str] = "bridge"

    road_seconds: float = field(metadata=metric("Road time"))
    ticks_total: int = field(metadata=metric("Ticks of the road that are over"))
    missed_answers_total: int = field(
        metadata=metric("Answers of agents that had not come when their tick's deadline passed")
    )
    vehicles_demanded_total: int = field(metadata=metric("Vehicles that have arrived at the road"))
    vehicles_entered_total: int = field(metadata=metric("Vehicles that have entered the road"))
    vehicles_left_total: int = field(metadata=metric("Vehicles that have left the road at its end"))
    vehicles_on_road: int = field(metadata=metric("Vehicles on the road"))
    vehicles_unattended: int = field(
        metadata=metric("Vehicles on the road of which a caretaker is in charge")
    )
