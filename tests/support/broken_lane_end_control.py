"""Planted bugs of the control of lane ends: stop lines, queues, and gaps for driving out."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
from attrs import evolve

from laneweave.protocol.lattice import Cell
from laneweave.protocol.vehicle.lane_ends import (
    DriveOut,
    LaneEnd,
    LaneEnds,
    drive_out,
    own_drive_out,
)
from laneweave.sim_bridge.bodies.motion_controller import MotionController, OffLatticePhase
from laneweave.sim_bridge.road import lane_end_control
from laneweave.sim_bridge.road.entry import EntryMeter
from laneweave.sim_bridge.road.lane_end_control import LaneEndControl
from laneweave.sim_bridge.road.roadside import EntranceRoom
from support.states import set_record

leave_lattice, drive_out_of = MotionController.leave_lattice, MotionController.drive_out


def no_stop_line(patch: pytest.MonkeyPatch) -> None:
    """Vehicles do not stop before the end of their lane."""
    patch.setattr(MotionController, "_lines_ahead", lambda *_: [])


def line_at_the_end(patch: pytest.MonkeyPatch) -> None:
    """There is no room to accelerate before the end of the lane."""
    ahead, ends_of = LaneEnds.ahead, LaneEnds.__iter__

    def at_the_end(end: LaneEnd) -> LaneEnd:
        return evolve(end, line_m=end.end_m)

    def ahead_of(self: LaneEnds, lane: int, s_m: float) -> LaneEnd | None:
        end = ahead(self, lane, s_m)
        return None if end is None else at_the_end(end)

    patch.setattr(LaneEnds, "ahead", ahead_of)
    patch.setattr(LaneEnds, "__iter__", lambda self: map(at_the_end, ends_of(self)))


def keeps_its_cells(patch: pytest.MonkeyPatch) -> None:
    """A vehicle that leaves the lattice keeps its cells."""

    def leave(self: MotionController) -> None:
        owned = self.record.owned
        leave_lattice(self)
        set_record(self.store, owned=owned)

    patch.setattr(MotionController, "leave_lattice", leave)


def gap_is_entered(patch: pytest.MonkeyPatch) -> None:
    """The entry meter only says that it keeps columns free, and sensors are not asked."""
    patch.setattr(LaneEndControl, "_is_free", lambda *_: True)
    patch.setattr(
        EntryMeter,
        "keep_free",
        lambda self, lane, count, _: range(
            self._columns[lane] - count + 1, self._columns[lane] + 1
        ),
    )


def gap_too_short(patch: pytest.MonkeyPatch) -> None:
    """A gap has room for the vehicle, but not for driving out."""
    for needed in (drive_out, own_drive_out):
        patch.setattr(lane_end_control, needed.__name__, partial(_in_one_column, needed))


def _in_one_column(needed: Callable[..., DriveOut], *given: object) -> DriveOut:
    return evolve(needed(*given), columns=1)


def starts_without_a_gap(patch: pytest.MonkeyPatch) -> None:
    """Vehicles drive out long before their gap passes."""
    patch.setattr(lane_end_control, "START_S", 1e9)
    patch.setattr(LaneEndControl, "_is_free", lambda *_: True)
    real = LaneEndControl._start

    def start(self: LaneEndControl, vehicle: object, gaps: object, t_s: float) -> object:
        return real(self, vehicle, gaps, t_s + 30.0)  # type: ignore[arg-type]

    patch.setattr(LaneEndControl, "_start", start)


def waits_forever(patch: pytest.MonkeyPatch) -> None:
    """Only the first gap is asked for."""
    patch.setattr(lane_end_control, "OPEN_GAPS", 10_000)


def last_first(patch: pytest.MonkeyPatch) -> None:
    """The rearmost vehicle of a queue drives out through the others."""
    real = LaneEndControl._waiting
    patch.setattr(LaneEndControl, "_waiting", lambda *given: real(*given)[::-1])


def drives_on(patch: pytest.MonkeyPatch) -> None:
    """A vehicle off the lattice aims at its cell, which is beyond the end of the lane."""

    def leave(self: MotionController) -> None:
        leave_lattice(self)
        self.off_lattice, self._past_line = OffLatticePhase.DRIVING_OUT, True

    patch.setattr(MotionController, "leave_lattice", leave)


def line_forgotten_when_driving_out(patch: pytest.MonkeyPatch) -> None:
    """The way out is blocked by the line at which the vehicle stands."""

    def drive(self: MotionController, cell: Cell) -> None:
        drive_out_of(self, cell)
        self._past_line = False

    patch.setattr(MotionController, "drive_out", drive)
    patch.setattr("laneweave.sim_bridge.bodies.motion_controller.STANDING_MPS", -1.0)


def full_lanes_are_entered(patch: pytest.MonkeyPatch) -> None:
    """Vehicles enter a lane whose queue reaches the entrance."""
    patch.setattr(EntranceRoom, "full_lanes", lambda *_: set())
