"""Metrics of a coordinator."""

from __future__ import annotations

from typing import ClassVar

from attrs import frozen

from laneweave.protocol.runtime.metrics import metric


@frozen
class CoordinatorMetrics:
    """Election and plans as seen by one candidate."""

    ABOUT: ClassVar[str] = "coordinator"

    leading: bool = metric("1 while this candidate leads, else 0")
    term: int = metric("Highest term that it has seen; its own term while it leads")
    candidates: int = metric("Candidates with recent heartbeats, itself included")
    elections_total: int = metric("Number of times that this process has begun to lead")
    plans_in_force: int = metric("Plans in force while it leads, of formations or of this slot")
    road_seconds: float = metric("Newest road time that it has received")
