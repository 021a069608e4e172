"""Settings of the bridge of a realm, among those of other processes."""

from __future__ import annotations

import threading
from typing import Any
from unittest.mock import MagicMock

import pytest

from laneweave.launch.observe.bridge_lookup import settings_of_bridge
from laneweave.protocol.runtime.transport import Received
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import access_of
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.process_messages import ProcessSettings
from laneweave.protocol.wire.topics import SETTINGS, Keys

BRIDGE = ProcessSettings(Name("bridge"), Name("bridge"), 5, {})
AGENT = ProcessSettings(Name("agent"), Name("v0001"), 7, {"formation.gap_m": "14.0"})


def test_settings_of_other_processes_do_not_end_the_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes that do not fit publish their own settings, and may be heard first."""
    access = access_of(Scenario(), "observer.status", {})

    def connect(_access: object, deliver: Any) -> MagicMock:  # noqa: ANN401 (of the transport)
        for delay_s, sent in ((0.0, AGENT), (0.2, BRIDGE)):
            key = Keys(access.realm).key(SETTINGS, role=sent.role, name=sent.name)
            threading.Timer(delay_s, deliver, [Received(key, encode(sent))]).start()
        return MagicMock()

    monkeypatch.setattr("laneweave.protocol.transports.zenoh.transport.connect_blocking", connect)
    assert settings_of_bridge(access, wait_s=20.0) == BRIDGE
