"""What goes to the page: one scene, then frames. All of it is compact JSON.

Lengths are in m, speeds in m/s, `t` is road time and `w` the wall clock, both in s. A frame is
complete in itself, so that any of them may be left out.

**Scene**, the first message: `{"scene": {...}}`

| field | meaning |
|---|---|
| `format` | `laneweave.watch/1` |
| `kind` | `live` or `recorded` |
| `title` | what is shown |
| `session` | another one is another server, whose frames have nothing to do with earlier ones |
| `step_s` | time between two frames: on the wall clock if live, road time if recorded |
| `first`, `last` | numbers of the frames that can be asked for now; `last` < `first`: none |
| `road`, `body_m`, `lattice`, `shade`, `colours`, `names` | what it takes to draw the road |
| `rolling` | vehicles own cells; otherwise formations own columns |
| `losses` | recorded: what the summary says of messages; live: null |

**Frame**: pushed if live, whenever something has changed, at most every `step_s`; asked for if
recorded, as are earlier frames if live.

| field | meaning |
|---|---|
| `n` | its number |
| `run` | number of the road; another one is another run, whose time begins at 0 |
| `t`, `w` | road time, null while there is none; wall clock, null if recorded |
| `status` | `lost`: no router; `waiting`: no road; `still`: no clock; `live`, `ended`, `recorded` |
| `since` | wall clock at which it became so; null if recorded |
| `leader` | [name, term], or null |
| `candidates` | [name, term, leading, silent] each |
| `counts` | [demanded, entered, on the road, left], or null |
| `loss` | [expected, lost] states of the last 100 ticks, or null |
| `plan` | [t, vehicles, solve ms, solver or null, fallback] of the newest plan, or null |
| `news` | the newest events, oldest first: [t, who, what, details] |
| `formations` | those on the road that are closed: [number, rear column, front column] each |
| `joined` | formations that plan together, at least two: lists of their numbers |
| `vehicles` | one row each, below |

**Row** of a vehicle: `[name, s, y, speed, lane, formation, hold, target, flags, estate]`: front
bumper and body centre, preferred lane (-1: not known), number of its formation (-1: none, or not
closed yet), hold cell and target cell as [column, lane] or 0, flags (1 moves, 2 has no agent, 4 is
not heard, 8 is overdue), and the other cells that it owns, column and lane by turns. The *target*
is the last cell of the plan that the vehicle has accepted and not completed, else 0.

**From the page**: `{"want": [from, to]}`, numbers of frames, at most `MOST_WANTED` of them. The
answer is `{"reel": [from, to], "first": n, "last": n, "frames": [...]}` with those that there are.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Final, Protocol

from attrs import frozen

from laneweave.launch.drawing.colours import lane_names
from laneweave.launch.drawing.road_scene import road_scene
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.tables import Scenario

FORMAT: Final = "laneweave.watch/1"
MOST_WANTED: Final = 50
"""Frames in one answer."""
MOVING, UNATTENDED, UNHEARD, OVERDUE = 1, 2, 4, 8
"""Flags of vehicles."""


class Film(Protocol):
    """Frames that can be asked for, by their numbers."""

    @property
    def scene(self) -> dict[str, Any]:
        """What does not change; see the module."""

    @property
    def first(self) -> int:
        """Number of the first frame that there is."""

    @property
    def last(self) -> int:
        """Number of the last frame that there is; less than `first`: none."""

    def frames(self, begin: int, end: int) -> list[str]:
        """Return the frames from `begin` up to and with `end`, as far as there are some."""


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
    estate: Sequence[Cell] = ()

    def compact(self) -> list[Any]:
        """Return it as JSON has it."""
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
            [part for cell in self.estate for part in cell],
        ]


def scene_of(scenario: Scenario, kind: str, title: str, step_s: float) -> dict[str, Any]:
    """Return the scene of a scenario, without the frames that there are."""
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
    """Return compact JSON; what it does not know is an error."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def reel(film: Film, begin: int, end: int) -> str:
    """Return the answer to a wish for some frames."""
    end = min(end, begin + MOST_WANTED - 1)
    frames = ",".join(film.frames(begin, end))
    head = compact({"reel": [begin, end], "first": film.first, "last": film.last})
    return f'{head[:-1]},"frames":[{frames}]}}'


def opening(film: Film, session: str) -> str:
    """Return the first message; the session tells this server from an earlier one."""
    bounds = {"first": film.first, "last": film.last, "session": session}
    return compact({"scene": film.scene | bounds})
