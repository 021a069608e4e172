"""A look at the bridge of a realm: whether there is one, and which settings it has."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from laneweave.launch.observe.observer import Observer
from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.runtime.settings_check import BRIDGE
from laneweave.protocol.security.connection import Access
from laneweave.protocol.wire.process_messages import ProcessSettings
from laneweave.protocol.wire.topics import BRIDGE_ALIVE, CLOCK, ROAD_STATUS, SETTINGS, Keys

TOKENS_S = 0.5
"""Time after which the tokens of all connected processes have been received."""
HEARD_S = 3.0
"""Time after which a bridge with a token, which publishes every second, counts as dead."""


def refuse_second_bridge(access: Access) -> None:
    """Check that no bridge drives a road in the realm, before another one starts.

    Raises:
        CommandFailedError: there is one.
        BadInputError: there is no router at the endpoint.
    """
    view = _look(access, TOKENS_S, _hears_bridge)
    if view.bridge_tokens:
        # The token of a host that has vanished remains until its lease expires.
        view = _look(access, HEARD_S, _hears_bridge)
    if _hears_bridge(view):
        started = time.strftime("%H:%M:%S", time.localtime(max(view.bridge_tokens) / 1e9))
        raise CommandFailedError(
            f"another bridge drives a road in realm {access.realm}, since {started}: stop it, "
            "or start this one with --takeover"
        )


def settings_of_bridge(access: Access, wait_s: float = HEARD_S) -> ProcessSettings | None:
    """Return the settings of the newest bridge of a realm; None: there is none.

    Raises:
        BadInputError: there is no router at the endpoint.
    """

    def newest(view: RoadView) -> ProcessSettings | None:
        found = [one for one in view.processes.settings.values() if one.role == BRIDGE]
        return max(found, key=lambda one: one.incarnation, default=None)

    def suffices(view: RoadView) -> bool:
        # Other processes publish their settings, too, and the token of an old bridge may remain.
        found = newest(view)
        return found is not None and found.incarnation >= max(view.bridge_tokens, default=0)

    return newest(_look(access, wait_s, suffices))


def _hears_bridge(view: RoadView) -> bool:
    ended = view.clock is not None and view.clock.ended
    heard = view.processes.bridges_heard_s.keys()
    return not ended and not view.bridge_tokens.isdisjoint(heard)


def _look(access: Access, wait_s: float, suffices: Callable[[RoadView], bool]) -> RoadView:
    """Return what is received within a time, or until it suffices."""
    from laneweave.protocol.transports.zenoh.transport import (  # noqa: PLC0415 (loads Zenoh)
        connect_blocking,
    )

    observer = Observer(
        Keys(access.realm), topics=(CLOCK, ROAD_STATUS, SETTINGS), tokens=(BRIDGE_ALIVE,)
    )
    with contextlib.closing(connect_blocking(access, observer.inbox.put)) as transport:
        observer.subscribe(transport)
        end_s = time.monotonic() + wait_s
        while (left_s := end_s - time.monotonic()) > 0 and not suffices(observer.view):
            observer.wait(min(left_s, 0.05))
    return observer.view
