"""Metrics of a coordinator."""

from __future__ import annotations

from typing import ClassVar

from attrs import field, frozen

from laneweave.protocol.runtime.metrics import metric


@frozen
class CoordinatorMetrics:
    """The election and the plans as one candidate sees them."""

    ABOUT: ClassVar[str] = "coordinator"

    leading: bool = field(metadata=metric("1 while this candidate leads, else 0"))
    term: int = field(metadata=metric("Highest term that it has seen; its own while it leads"))
    candidates: int = field(metadata=metric("Candidates that it hears, itself included"))
    elections_total: int = field(metadata=metric("Times that this process has begun to lead"))
    plans_in_force: int = field(
        metadata=metric("Plans in force, of formations or of this slot, while it leads")
    )
    road_seconds: float = field(metadata=metric("Newest road time that it has heard"))
