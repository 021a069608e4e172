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
    term: int = metric("Highest term seen; the candidate's own term while it leads")
    candidates: int = metric("Candidates with recent heartbeats, including this one")
    elections_total: int = metric("Number of times that this process has become leader")
    plans_in_force: int = metric("Plans in force while leading, for formations or for this slot")
    road_seconds: float = metric("Newest road time received")
