"""Messages that travel as they are make the same run as bytes."""

from __future__ import annotations

import pytest

from laneweave.protocol.runtime.node import Arrived, Listen
from laneweave.protocol.transports.simulated.network import Parcel, SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import Conditions
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.messages import Heartbeat, Name
from laneweave.protocol.wire.topics import COMMAND, HEARTBEAT, Keys
from support.node_recorder import CALM, REALM, STORM, Recorder, at_start, beat, chatter

KEY = Keys(REALM).key(HEARTBEAT, coordinator="a")
BEAT = Heartbeat(Name("a"), 1, 7, leading=False, formations=0)


def listening(*, in_kind: bool) -> tuple[SimulatedNetwork, Recorder]:
    network = SimulatedNetwork(1, CALM, in_kind=in_kind)
    core = Recorder(at_start(Listen(HEARTBEAT)))
    network.add("b", core, REALM)
    network.run(0.1)
    return network, core


def arrived(core: Recorder) -> list[object]:
    return [event.message for _, event in core.events if isinstance(event, Arrived)]


@pytest.mark.parametrize("conditions", [CALM, STORM], ids=["calm", "storm"])
@pytest.mark.parametrize("seed", [1, 5])
def test_whoever_talks_sees_the_same(seed: int, conditions: Conditions) -> None:
    seen = chatter(seed, conditions)
    assert seen == chatter(seed, conditions, in_kind=True)
    assert sum(len(events) for events in seen[0]) > 300


def test_a_message_arrives_as_the_one_that_was_sent() -> None:
    network, core = listening(in_kind=True)
    effect = beat(7)
    network.add("a", Recorder(at_start(effect)), REALM)
    network.run(0.2)
    (message,) = arrived(core)
    assert message is effect.message
    network, core = listening(in_kind=False)
    network.add("a", Recorder(at_start(effect)), REALM)
    network.run(0.2)
    (message,) = arrived(core)
    assert message == effect.message
    assert message is not effect.message


def test_bytes_are_understood_all_the_same() -> None:
    network, core = listening(in_kind=True)
    network.inject(KEY, encode(BEAT))
    network.inject(KEY, b"nonsense")
    network.run(0.2)
    assert arrived(core) == [BEAT]


def test_a_key_that_is_none_is_refused() -> None:
    network, core = listening(in_kind=True)
    network.inject(f"laneweave/{REALM}/heartbeat/a/b", Parcel(BEAT))
    network.inject(Keys(REALM).key(COMMAND, vehicle="a"), Parcel(BEAT))
    network.run(0.2)
    assert arrived(core) == []
