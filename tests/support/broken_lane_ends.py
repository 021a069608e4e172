"""Planted bugs of lanes that end: rules of leaving the lattice and entering it again."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import pytest
from msgspec.structs import replace

from laneweave.agents.core import AgentCore
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.wire.messages import (
    Census,
    CensusEntry,
    Command,
    Name,
    Sense,
)
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from laneweave.sim_bridge.road.lane_end_control import LaneEndControl

accept_command = MotionController.accept_command


def never_leaves(patch: pytest.MonkeyPatch) -> None:
    """A vehicle whose cell has passed the stop line stays in it."""
    patch.setattr(LaneEnds, "has_passed", lambda *_, **_more: False)


def agents_move_vehicles_without_cells(patch: pytest.MonkeyPatch) -> None:
    """The motion controller of a vehicle without cells executes commands."""

    def accept(self: MotionController, command: Command) -> bool:
        off_lattice, self.off_lattice = self.off_lattice, None
        try:
            return accept_command(self, command)
        finally:
            self.off_lattice = off_lattice

    patch.setattr(MotionController, "accept_command", accept)
    agent_remembers(patch)


def agent_remembers(patch: pytest.MonkeyPatch) -> None:
    """An agent does not notice that its vehicle has left the lattice."""
    act = AgentCore._act

    def forgetful(self: AgentCore, sense: Sense, *, in_charge: bool, drove: bool) -> list[object]:
        blind = replace(sense, off_lattice=False)
        self._sense = blind
        return act(self, blind, in_charge=in_charge, drove=drove)  # type: ignore[return-value]

    patch.setattr(AgentCore, "_act", forgetful)


def gaps_are_given_away(patch: pytest.MonkeyPatch) -> None:
    """The roadside assigns the cells of a gap to vehicles near them."""
    patch.setattr(LaneEndControl, "is_kept_free", lambda *_: False)


def still_listed(patch: pytest.MonkeyPatch) -> None:
    """Leaders plan for vehicles that have left the lattice."""

    def on_lattice(census: Census) -> tuple[CensusEntry, ...]:
        return census.on_road

    patch.setattr(Census, "on_lattice", property(on_lattice))


def gap_taken_too_early(patch: pytest.MonkeyPatch) -> None:
    """A vehicle gets its cells when it begins to drive out, from another gap."""
    update = LaneEndControl.update

    def early(
        self: LaneEndControl, vehicles: Mapping[Name, object], t_s: float
    ) -> Collection[object]:
        changes = list(update(self, vehicles, t_s))  # type: ignore[arg-type]
        for gaps in self._gaps.values():
            for gap in gaps:
                if gap.vehicle is not None and gap.columns[0] > -(10**6):
                    gap.columns = range(gap.columns[0] - 2, gap.columns[-1] - 1)
        return changes

    patch.setattr(LaneEndControl, "update", early)
