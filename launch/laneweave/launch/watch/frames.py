"""Messages between server and page: one scene, then frames, all as compact JSON.

Lengths are in m, speeds in m/s; `t` is road time and `w` wall-clock time in s. A frame does not
depend on earlier frames, so any frame may be skipped.

**Scene**, the first message: `{"scene": {...}}`

| field | meaning |
|---|---|
| `format` | `laneweave.watch/1` |
| `kind` | `live` or `recorded` |
| `title` | name of the realm or of the run |
| `session` | unique identifier of the server; frames of other sessions are unrelated |
| `step_s` | time between two frames: wall-clock time if live, road time if recorded |
| `first`, `last` | numbers of the available frames; `last` < `first`: none |
| `road`, `body_m`, `bodies_m`, `lattice`, `shade`, `colours`, `neutral` | parameters for drawing |
| `preferences` | whether vehicles have preferred lanes |
| `legend` | colours of vehicles: list of [colour, meaning] |
| `has_formations` | whether there are formations: not in the rolling operation, nor with methods |

**Frame**: live frames are pushed on changes, at most every `step_s`; recorded frames and earlier
live frames are sent on request.

| field | meaning |
|---|---|
| `n` | number of the frame |
| `run` | number of the run; the road time of each run begins at 0 |
| `t`, `w` | road time, null before the first clock; wall-clock time, null if recorded |
| `status` | `lost`: no router; `waiting`: no road; `still`: no clock; `live`, `ended`, `recorded` |
| `since` | wall-clock time at which the status began; null if recorded |
| `findings` | what is wrong, the gravest first: list of [process, what, advice]; recorded: none |
| `leader` | [name, term], or null |
| `candidates` | list of [name, term, leading, silent] |
| `counts` | [demanded, entered, on the road, left], or null |
| `plan` | newest plan: [t, vehicles, solve ms, solver or null, fallback], or null |
| `news` | newest events, oldest first: list of [t, process, kind, details] |
| `formations` | closed formations on the road: list of [number, rear column, front column] |
| `joined` | lists of the numbers of formations that plan together |
| `vehicles` | list of rows, one per vehicle |
| `parts` | parts of lanes: list of [lane, from, to, kind]; kind 1: closed for a time, 2: cleared |
| `others` | fast vehicles of other systems: list of [name, lane, s of the front, length] (live) |

**Row** of a vehicle: `[name, s, y, speed, lane, formation, hold, target, flags, owned]`: s of the
front bumper, y of the body centre, preferred lane (-1: none, or unknown), number of the closed
formation (-1: none), hold cell and target cell as [column, lane] or 0, sum of flags (1 moves, 2 has
no agent, 4 not heard from, 8 overdue), the other owned cells as column, lane, column, lane, ...,
and the type if it is not a car. The target is the last cell of the plan that the vehicle has
accepted but not completed.

**Request** from the page: `{"want": [from, to]}`, at most `MAX_REQUESTED` frame numbers. The
response has the available frames: `{"reel": [from, to], "first": n, "last": n, "frames": [...]}`.

**Ending**, the last message of the page of `laneweave run --watch`: `{"end": text}`. The page shows
the text and does not connect again.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final, Protocol

from attrs import define, field, frozen

from laneweave.launch.drawing.road_scene import road_scene
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import solver_of_event
from laneweave.protocol.wire.events import (
    ENTERED,
    FORMATION_CLOSED,
    LEFT,
    PLAN_EVENTS,
    PLAN_IN_FORCE,
    TRANSFER_ABORTED,
)
from laneweave.protocol.wire.messages import CAR

FORMAT: Final = "laneweave.watch/1"
MAX_REQUESTED: Final = 50
"""Maximum number of frames in a response."""
MOVING, UNATTENDED, UNHEARD, OVERDUE = 1, 2, 4, 8
"""Flags of vehicles."""

CLOSED_PART, CLEARED_PART = 1, 2
"""Kinds of parts of lanes."""

MAX_FRAMES: Final = 3000
"""Five minutes at ten frames per second."""
MAX_CHARACTERS: Final = 48_000_000

MAX_EVENTS: Final = 8
MAX_EVENT_CHARACTERS: Final = 90
MAX_NUMBER: Final = 1e12
FREQUENT_EVENTS: Final = (
    *PLAN_EVENTS, PLAN_IN_FORCE, TRANSFER_ABORTED, FORMATION_CLOSED, ENTERED, LEFT,
)  # fmt: skip
"""Events not shown, because they would displace all others."""


class FrameSource(Protocol):
    """Source of frames that can be requested by number."""

    @property
    def scene(self) -> dict[str, Any]:
        """The scene, without the fields `session`, `first` and `last`."""

    @property
    def first(self) -> int:
        """Number of the first available frame."""

    @property
    def last(self) -> int:
        """Number of the last available frame; less than `first` if there are none."""

    def frames(self, begin: int, end: int) -> list[str]:
        """Return the available frames from `begin` to `end`, both included."""


@define
class FrameBuffer:
    """`FrameSource` of the newest frames of a live road, limited in number and total size."""

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
        """Return the available frames from `begin` to `end`, both included."""
        first = self.first
        return [
            self._frames[number - first]
            for number in range(max(begin, first), min(end, self.last) + 1)
        ]


@define
class EventFeed:
    """The newest events of a run except `FREQUENT_EVENTS`."""

    _rows: deque[list[Any]] = field(factory=lambda: deque(maxlen=MAX_EVENTS))

    def add(self, t_s: float, process: str, kind: str, data: Mapping[str, Any]) -> None:
        """Add an event, unless its kind is frequent."""
        if kind not in FREQUENT_EVENTS:
            self._rows.append([round(t_s, 1), process, kind, _details(data)])

    @property
    def rows(self) -> list[list[Any]]:
        """[t, process, kind, details] of each event, oldest first."""
        return list(self._rows)


def _details(data: Mapping[str, Any]) -> str:
    """Return the data of an event as a short line."""
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
    """Return the `plan` field of a frame for a plan event; None for other events."""
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
    """Return the rounded number, or 0 if the value is not a number or is too large."""
    if isinstance(value, (int, float)) and abs(value) < MAX_NUMBER:
        return round(float(value), 2)
    return 0.0


@frozen
class Row:
    """State of a vehicle in a frame."""

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
    vehicle_type: str = CAR

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
            *([self.vehicle_type] if self.vehicle_type != CAR else []),
        ]


def part_row(lane: int, from_m: float, to_m: float, kind: int) -> list[Any]:
    """Return a row of the field `parts` of a frame."""
    return [lane, round(from_m, 1), round(to_m, 1), kind]


def scene_of(scenario: Scenario, kind: str, title: str, step_s: float) -> dict[str, Any]:
    """Return the scene of a scenario; see `FrameSource.scene`."""
    return {
        "format": FORMAT,
        "kind": kind,
        "title": title,
        "step_s": step_s,
        **road_scene(scenario, recorded=kind == "recorded"),
        "has_formations": scenario.formation.traits.has_formations,
    }


def compact(value: object) -> str:
    """Return compact JSON; raise ValueError for NaN and infinity."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def batch(source: FrameSource, begin: int, end: int) -> str:
    """Return the response to a request for frames."""
    end = min(end, begin + MAX_REQUESTED - 1)
    frames = ",".join(source.frames(begin, end))
    head = compact({"reel": [begin, end], "first": source.first, "last": source.last})
    return f'{head[:-1]},"frames":[{frames}]}}'


def ending(text: str) -> str:
    """Return the last message of the page of a run."""
    return compact({"end": text})


def opening(source: FrameSource, session: str) -> str:
    """Return the first message of a server with the identifier `session`."""
    bounds = {"first": source.first, "last": source.last, "session": session}
    return compact({"scene": source.scene | bounds})
