"""The newest value, or the newest road, that senders show.

Numbers of a correct sender only grow, so a lower one is late. But a forged or faulty message may
have a number above all that follow. So a value is forgotten when its sender shows it no longer.
"""

from __future__ import annotations

import math
from typing import Any

from attrs import define, field

from laneweave.protocol.errors import BadInputError

FORGET_S = 0.5
"""Time after which a value is forgotten if only other ones arrive."""
AHEAD_S = 10.0
"""Maximum lead of a road time over the newest one, in addition to the time since that one."""


@define
class Newest:
    """The newest value, which is forgotten if only lower ones arrive for some time."""

    value: Any = None
    """None: no value yet."""
    shown_s: float = 0.0
    """Time at which it was last received (node clock)."""
    _refused_since_s: float | None = None
    """Time of the first other value since then."""

    def take(
        self,
        value: Any,  # noqa: ANN401
        now_s: float,
        *,
        ahead: bool = False,
        forget_s: float = FORGET_S,
    ) -> bool:
        """Take a value unless it is late or too far `ahead`; return whether it is the newest."""
        if self.value is not None and (ahead or value < self.value):
            if self._refused_since_s is None:
                self._refused_since_s = now_s
            if now_s < self._refused_since_s + forget_s:
                return False
        self.value, self.shown_s, self._refused_since_s = value, now_s, None
        return True


@define
class NewestRoad:
    """The newest road: incarnation of its bridge, and its road time.

    A road is shown by the messages and by the liveliness token of its bridge.
    """

    max_pace: float
    """Maximum road seconds per second of the node's clock."""
    number: int = 0
    """Number of changes: after a change, everything received before is of another road."""
    _bridge: Newest = field(factory=Newest)
    _time: Newest = field(factory=Newest)
    _tokens: set[int] = field(factory=set)
    """Bridges with tokens."""

    @property
    def bridge(self) -> int:
        """Incarnation of the bridge; -1: unknown."""
        return -1 if self._bridge.value is None else int(self._bridge.value)

    @property
    def t_s(self) -> float:
        """Road time [s]; 0 before the first message."""
        return self._time.value or 0.0

    def latest_s(self, now_s: float) -> float:
        """Return the latest possible road time, infinity if none is known."""
        if self._time.value is None:
            return math.inf
        return self.t_s + AHEAD_S + self.max_pace * max(now_s - self._time.shown_s, 0.0)

    def on_token_up(self, bridge: int, now_s: float) -> None:
        """Register the token of a bridge; a newer bridge has a new road."""
        self._tokens.add(bridge)
        self._take_bridge(bridge, now_s)

    def on_token_down(self, bridge: int, now_s: float) -> None:
        """Return to the newest bridge that still has a token, if any."""
        self._tokens.discard(bridge)
        if bridge == self.bridge and self._tokens:
            self._bridge = Newest()
            self._take_bridge(max(self._tokens), now_s)

    def on_link_down(self) -> None:
        """Forget all tokens: they are shown again when the connection is restored."""
        self._tokens.clear()

    def on_message(self, bridge: int, t_s: float, now_s: float, forget_s: float = FORGET_S) -> bool:
        """Register a message of a bridge; return whether it is of the newest road.

        Args:
            bridge: incarnation of the bridge that sent the message; 0: not given.
            t_s: road time of the message [s].
            now_s: the node's clock.
            forget_s: time after which a newer road is forgotten if it sends nothing.

        Raises:
            BadInputError: the road time is later than possible.
        """
        if bridge and not self._take_bridge(bridge, now_s, forget_s):
            return False
        latest_s, before_s = self.latest_s(now_s), self.t_s
        if not self._time.take(t_s, now_s, ahead=t_s > latest_s, forget_s=forget_s):
            if t_s > latest_s:
                raise BadInputError("t_s", t_s, f"at most {latest_s:g}")
            return True  # late
        if t_s < before_s:
            self.number += 1
        return True

    def _take_bridge(self, bridge: int, now_s: float, forget_s: float = FORGET_S) -> bool:
        before = self.bridge
        if not self._bridge.take(bridge, now_s, forget_s=forget_s):
            return False
        if bridge != before:
            self.number += 1
            self._time = Newest()
        return True
