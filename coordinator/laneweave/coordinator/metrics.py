"""Metrics of a coordinator."""

from __future__ import annotations

from typing import ClassVar

from attrs import frozen

from laneweave.protocol.runtime.metrics import metric


@frozen
class CoordinatorMetrics:
    """The election and the plans as one candidate sees them."""

    ABOUT: ClassVar[str] = "coordinator"

    leading: bool = metric("1 while this candidate leads, else 0")
    term: int = metric("Highest term that it has seen; its own while it leads")
    candidates: int = metric("Candidates that it hears, itself included")
    elections_total: int = metric("Times that this process has begun to lead")
    plans_in_force: int = metric("Plans in force, of formations or of this slot, while it leads")
    road_seconds: float = metric("Newest road time that it has heard")
