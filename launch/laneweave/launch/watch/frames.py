"""What is sent to the page: one scene, then frames. All of it is compact JSON.

Lengths are in m, speeds in m/s, `t` is road time and `w` the wall clock, both in s. A frame is
complete in itself, so that any of them may be skipped.

**Scene**, the first message: `{"scene": {...}}`

| field | meaning |
|---|---|
| `format` | `laneweave.watch/1` |
| `kind` | `live` or `recorded` |
| `title` | what is shown |
| `session` | identifies this server; frames of another session are unrelated |
| `step_s` | time between two frames: on the wall clock if live, road time if recorded |
| `first`, `last` | numbers of the frames that can be requested now; `last` < `first`: none |
| `road`, `body_m`, `lattice`, `shade`, `colours`, `names` | how to draw the road |
| `rolling` | vehicles own cells; otherwise formations own columns |
| `losses` | recorded: message counts of the summary; live: null |

**Frame**: pushed if live, whenever something has changed, at most every `step_s`; requested if
recorded, as are earlier frames if live.

| field | meaning |
|---|---|
| `n` | its number |
| `run` | number of the road; a new run has a new number, and its time begins at 0 |
| `t`, `w` | road time, null before the first clock; wall clock, null if recorded |
| `status` | `lost`: no router; `waiting`: no road; `still`: no clock; `live`, `ended`, `recorded` |
| `since` | wall clock at which the status began; null if recorded |
| `leader` | [name, term], or null |
| `candidates` | [name, term, leading, silent] each |
| `counts` | [demanded, entered, on the road, left], or null |
| `loss` | [expected, lost] states of the last 100 ticks, or null |
| `plan` | [t, vehicles, solve ms, solver or null, fallback] of the newest plan, or null |
| `news` | the newest events, oldest first: [t, process, kind, details] |
| `formations` | the closed ones on the road: [number, rear column, front column] each |
| `joined` | formations that plan together, at least two: lists of their numbers |
| `vehicles` | one row each, below |

**Row** of a vehicle: `[name, s, y, speed, lane, formation, hold, target, flags, owned]`: front
bumper and body centre, preferred lane (-1: not known), number of its formation (-1: none, or not
closed yet), hold cell and target cell as [column, lane] or 0, flags (1 moves, 2 has no agent, 4 is
not heard, 8 is overdue), and the other cells that it owns: column, lane, column, lane, ... The
*target* is the last cell of the plan that the vehicle has accepted and not completed, else 0.

**From the page**: `{"want": [from, to]}`, numbers of frames, at most `MAX_REQUESTED` of them. The
answer is `{"reel": [from, to], "first": n, "last": n, "frames": [...]}` with those that exist.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final, Protocol

from attrs import define, field, frozen

from laneweave.launch.drawing.colours import lane_names, road_scene
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario, solver_of_event
from laneweave.protocol.wire.events import (
    ENTERED,
    FORMATION_CLOSED,
    LEFT,
    PLAN_EVENTS,
    PLAN_IN_FORCE,
)

FORMAT: Final = "laneweave.watch/1"
MAX_REQUESTED: Final = 50
"""Frames in one answer."""
MOVING, UNATTENDED, UNHEARD, OVERDUE = 1, 2, 4, 8
"""Flags of vehicles."""

MAX_FRAMES: Final = 3000
"""Five minutes at ten frames a second."""
MAX_CHARACTERS: Final = 48_000_000

MAX_EVENTS: Final = 8
MAX_EVENT_CHARACTERS: Final = 90
MAX_NUMBER: Final = 1e12
FREQUENT_EVENTS: Final = (
    *PLAN_EVENTS, PLAN_IN_FORCE, FORMATION_CLOSED, ENTERED, LEFT,
)  # fmt: skip
"""Events that are not shown, because they would displace all others."""


class FrameSource(Protocol):
    """Frames that can be requested by their numbers."""

    @property
    def scene(self) -> dict[str, Any]:
        """The scene; see the module."""

    @property
    def first(self) -> int:
        """Number of the first frame that exists."""

    @property
    def last(self) -> int:
        """Number of the last frame that exists; less than `first`: none does."""

    def frames(self, begin: int, end: int) -> list[str]:
        """Return the frames from `begin` to `end` (included), as far as they exist."""


@define
class FrameBuffer:
    """The newest frames of a live road, bounded in number and in size; a `FrameSource`."""

    scene: dict[str, Any]
    max_frames: int = MAX_FRAMES
    max_characters: int = MAX_CHARACTERS
    next: int = 0
    """Number of the next frame."""
    _frames: deque[str] = field(factory=deque)
    _characters: int = 0

    def append(self, frame: str) -> None:
        """Add the frame with the number `next`."""
        self._frames.append(frame)
        self._characters += len(frame)
        self.next += 1
        while len(self._frames) > self.max_frames or (
            self._characters > self.max_characters and len(self._frames) > 1
        ):
            self._characters -= len(self._frames.popleft())

    @property
    def first(self) -> int:
        """Number of the oldest frame."""
        return self.next - len(self._frames)

    @property
    def last(self) -> int:
        """Number of the newest frame."""
        return self.next - 1

    def frames(self, begin: int, end: int) -> list[str]:
        """Return the frames from `begin` to `end` (included), as far as they exist."""
        first = self.first
        return [
            self._frames[number - first]
            for number in range(max(begin, first), min(end, self.last) + 1)
        ]


@define
class EventFeed:
    """The newest events of a run, without the frequent ones."""

    _rows: deque[list[Any]] = field(factory=lambda: deque(maxlen=MAX_EVENTS))

    def add(self, t_s: float, process: str, kind: str, data: Mapping[str, Any]) -> None:
        """Add an event."""
        if kind not in FREQUENT_EVENTS:
            self._rows.append([round(t_s, 1), process, kind, _details(data)])

    @property
    def rows(self) -> list[list[Any]]:
        """All of them, oldest first: [t, process, kind, details]."""
        return list(self._rows)


def _details(data: Mapping[str, Any]) -> str:
    """Return an event's data in one short line."""
    text = ", ".join(f"{name} {_brief(value)}" for name, value in data.items())
    if len(text) <= MAX_EVENT_CHARACTERS:
        return text
    return text[: MAX_EVENT_CHARACTERS - 1] + "…"


def _brief(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return " ".join(_brief(item) for item in value)
    return str(value)


def plan_row(t_s: float, kind: str, data: Mapping[str, Any]) -> list[Any] | None:
    """Return the `plan` field of a frame from an event; None if no plan was made."""
    if kind not in PLAN_EVENTS:
        return None
    return [
        round(t_s, 1),
        _number(data.get("vehicles")),
        _number(data.get("solve_ms")),
        solver_of_event(kind, data),
        data.get("fallback") is True,
    ]


def _number(value: object) -> float:
    """Return a number that can be shown; 0 for any other value."""
    if isinstance(value, (int, float)) and abs(value) < MAX_NUMBER:
        return round(float(value), 2)
    return 0.0


@frozen
class Row:
    """One vehicle in a frame."""

    name: str
    s_m: float
    y_m: float
    speed_mps: float
    preferred_lane: int
    formation: int
    hold: Cell | None
    target: Cell | None
    flags: int
    owned: Sequence[Cell] = ()

    def compact(self) -> list[Any]:
        """Return the row as a JSON array."""
        return [
            self.name,
            round(self.s_m, 2),
            round(self.y_m, 2),
            round(self.speed_mps, 2),
            self.preferred_lane,
            self.formation,
            self.hold or 0,
            self.target or 0,
            self.flags,
            [part for cell in self.owned for part in cell],
        ]


def scene_of(scenario: Scenario, kind: str, title: str, step_s: float) -> dict[str, Any]:
    """Return the scene of a scenario, without the numbers of frames."""
    return {
        "format": FORMAT,
        "kind": kind,
        "title": title,
        "step_s": step_s,
        **road_scene(scenario),
        "names": list(lane_names(scenario.road.lanes)),
        "rolling": scenario.formation.rolling,
        "losses": None,
    }


def compact(value: object) -> str:
    """Return compact JSON; raise an error for values that JSON does not have."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def batch(source: FrameSource, begin: int, end: int) -> str:
    """Return the answer to a request for some frames."""
    end = min(end, begin + MAX_REQUESTED - 1)
    frames = ",".join(source.frames(begin, end))
    head = compact({"reel": [begin, end], "first": source.first, "last": source.last})
    return f'{head[:-1]},"frames":[{frames}]}}'


def opening(source: FrameSource, session: str) -> str:
    """Return the first message; `session` distinguishes this server from an earlier one."""
    bounds = {"first": source.first, "last": source.last, "session": session}
    return compact({"scene": source.scene | bounds})
