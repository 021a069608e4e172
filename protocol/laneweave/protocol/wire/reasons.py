"""Reasons why a vehicle does not reach its lane, in the data of events.

Each is written by the process that knows it: a coordinator in `formation-too-late` and
`lane-out-of-reach`, the bridge in `left-off-lane`.
"""

from __future__ import annotations

from typing import Final

TOO_LATE: Final = "too-late"
"""Coordinator: the vehicle passes the place where its lane changes end before it could move."""
CLOSED_LANE: Final = "closed-lane"
"""Coordinator: no lane change is possible from the lane of the vehicle."""
BLOCKED: Final = "blocked"
"""Coordinator: vehicles that only hold their cells are on the way."""
NO_ROOM: Final = "no-room"
"""Coordinator: the lanes that lead to the destination have too few cells in the formation."""
ROAD_TOO_SHORT: Final = "road-too-short"
"""Coordinator: when the formation closed, it was too late for any step."""
LATE_PROMISES: Final = "late-promises"
"""Coordinator: vehicles promised too late, or a plan that was in force has to be replaced."""
PLANNING_FAILED: Final = "planning-failed"
"""Coordinator: planning failed until it was too late."""
NO_LEADER: Final = "no-leader"
"""Coordinator: none led until it was too late. Bridge: none leads."""
NO_AGENT: Final = "no-agent"
"""Both: no agent drives the vehicle, so it only holds its cell."""
MISSED_EXIT: Final = "missed-exit"
"""Bridge: the vehicle began its move into or out of an exit lane too late."""
STOPPED: Final = "stopped-at-lane-end"
"""Bridge: the vehicle stopped before the end of its lane."""
NO_PLAN: Final = "no-plan"
"""Bridge: the process in charge of the vehicle has accepted no plan."""
PLANNED: Final = "planned"
"""Bridge: none of these; the vehicle had an agent and a plan."""
