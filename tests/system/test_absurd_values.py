"""Well-formed messages with numbers that no correct sender has: planning goes on without delay."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import msgpack
import pytest
from attrs import frozen
from msgspec.structs import fields

from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.runtime.transport import Delivery
from laneweave.protocol.scenario.deployment_fields import Shard
from laneweave.protocol.scenario.formation_table import SNAPSHOT_S
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.codec import VERSION
from laneweave.protocol.wire.field_types import Message
from laneweave.protocol.wire.messages import Heartbeat, RoadClock
from laneweave.protocol.wire.topics import CLOCK, HEARTBEAT, Keys, Quality
from support.deployments import REALM, free_port, start_router, stop
from support.forger import HUGE, ROWS, Forger
from support.harness import (
    RUN_S,
    Lab,
    check_safe_and_complete,
    events,
    log_lines,
    summary,
    trips,
)
from support.secured import LINKS, SECURITY, Network

KEYS = Keys("default")
FLOOD, FLOOD_S = 168_000, 6.0
"""Number of junk messages, and the time in which they are sent."""
MINUTE_S = 60.0
RECOVERY_S = 2.0
"""Longest time from the last forged message, or from when a plan is due, to the plan."""
WATCHED_S = 3.0
"""Time after the last forged message within which plans that become due are examined."""
PACE = 3.0
ROAD = """\
schema = "laneweave.scenario/1"

[road]
s2_m = 100.0
s3_m = 500.0
"""
SMALL_FORMATIONS = """
[formation]
max_vehicles = 3
"""
"""So that one is planned every second or two."""
WITHOUT_PLANS = {
    "census-empty",
    "clock-bridge-possible",
    "sense-bridge-possible",
    "token-possible",
}
"""Rows with possible numbers that show another road: while they arrive, nothing is planned."""
ALL = [row for row in ROWS if row not in WITHOUT_PLANS]
OUTBIDDING = {"prepare-possible", "state-term-possible"}
"""Rows with promises to another leader that are within the bounds. In the rolling operation, other
vehicles that need cells of the victim cannot move either."""
SLOT_S = 6.0
ROLLING = f"""
[formation]
operation = "rolling"
cycle_s = {SLOT_S}
"""
SECURED_DEMAND = """
[demand]
volume_veh_per_lane_h = 900.0
duration_s = 145.0

"""
DEMAND = ("--volume", "1400", "--duration", "40", "--seed", "1")


@frozen
class Forged:
    """Number of forged messages, and the period of road time in which they were sent."""

    messages: int
    began_s: float
    ended_s: float


@pytest.fixture
def road(lab: Lab) -> Path:
    return lab.path("absurd.toml", ROAD + SMALL_FORMATIONS)


@contextmanager
def running(lab: Lab, road: Path, *options: object) -> Iterator[tuple[Forger, Path]]:
    """Run the road; yield once formations are planned; check what is promised at the end."""
    folder = lab.folder / "out"
    process = lab.start(
        *("run", road, *DEMAND, "--vehicles-per-process", "8", *options), "--out", folder
    )
    lab.wait_until(lambda: len(events(folder, "plan-in-force")) > 0)
    forger = Forger(Access(lab.router_endpoint))
    try:
        yield forger, folder
    finally:
        forger.close()
    ended = lab.finish(process)
    assert ended.status == 0, ended
    check_after(folder)


def check_after(folder: Path) -> None:
    """Check what holds after any forged messages, whatever they name."""
    check_safe_and_complete(folder)
    assert [line for line in log_lines(folder) if line["level"] == "error"] == []


def off_lane(folder: Path) -> set[str]:
    """Return the vehicles that did not reach their lane."""
    return {
        name for name, trip in trips(folder).items() if trip["final_lane"] != trip["preferred_lane"]
    }


def forge(forger: Forger, rows: list[str], seconds: float = MINUTE_S, pace: float = 1.0) -> Forged:
    """Forge for some time: seconds of the road at a pace, and at least of the clock at that pace.

    The victim stays the same until it leaves the road.
    """
    forger.choose()
    began_s, until_s = forger.t_s, time.monotonic() + seconds / pace
    sent = forger.send(
        [ROWS[row] for row in rows],
        lambda: forger.t_s >= began_s + seconds and time.monotonic() >= until_s,
    )
    return Forged(sent, began_s, forger.t_s)


def watch() -> None:
    """Wait until plans that become due within `WATCHED_S` should be in force."""
    time.sleep(WATCHED_S + RECOVERY_S + 1.0)


def delays_s(folder: Path, forger: Forger, forged: Forged) -> list[float]:
    """Return the time from the last forged message, or a closed formation, to each plan due.

    Plans are due for formations closed from the first message until `WATCHED_S` after the last one,
    unless they are too close to the end of the road by then. A leader that has forgotten its plan
    and adopts it does not report that it is in force.
    """
    planned = {
        event["formation"]: event["t_s"]
        for kind in ("plan-made", "plan-in-force")
        for event in events(folder, kind)[::-1]
    }
    ended_s = forger.clock_s(forged.ended_s)
    left_s = {event["vehicle"]: event["t_s"] for event in events(folder, "left")}
    too_late = {event["formation"] for event in events(folder, "formation-too-late")}
    return [
        _delay_s(forger, forged, closed["t_s"], planned.get(closed["formation"], math.inf))
        for closed in events(folder, "formation-closed")
        if closed["t_s"] >= forged.began_s
        and forger.clock_s(closed["t_s"]) <= ended_s + WATCHED_S
        and closed["formation"] not in too_late
        and forger.clock_s(left_s[closed["vehicles"][0]]) > ended_s + RECOVERY_S
    ]


def _delay_s(forger: Forger, forged: Forged, due_s: float, planned_s: float) -> float:
    if planned_s <= forged.ended_s:
        return 0.0
    # Later than the forger's last clock: infinity.
    return forger.clock_s(planned_s) - forger.clock_s(max(due_s, forged.ended_s))


def leader_changes(folder: Path) -> int:
    return len(events(folder, "leader")) - 1


@pytest.mark.slow
@pytest.mark.more
def test_single_absurd_messages_stop_nothing(lab: Lab, road: Path) -> None:
    with running(lab, road, "--pace", PACE) as (forger, folder):
        for row in ROWS.values():
            forger.choose()
            row(forger)
            time.sleep(0.3)
            forger.withdraw_tokens()

    assert off_lane(folder) <= forger.named
    assert leader_changes(folder) <= 1
    assert 0 < summary(folder)["messages"]["rejected"] < 1e6
    assert summary(folder)["messages"]["published"] < 1e8
    assert summary(folder)["tracking"]["solves"] < 1e6


@pytest.mark.full
@pytest.mark.parametrize("row", ROWS)
def test_a_minute_of_one_absurd_message_delays_planning_by_at_most_two_seconds(
    lab: Lab, road: Path, row: str
) -> None:
    """A minute of the road; as many messages as in a minute of the clock at 50 per second."""
    with running(lab, road, "--duration", "105", "--pace", PACE) as (forger, folder):
        forged = forge(forger, [row], pace=PACE)
        watch()

    assert forged.messages >= 50 * MINUTE_S
    excused = entered_until(folder, forged.ended_s) if row in WITHOUT_PLANS else frozenset()
    check_planning(folder, forger, delays_s(folder, forger, forged), excused)


def entered_until(folder: Path, t_s: float) -> frozenset[str]:
    """Return the vehicles that entered until a road time."""
    return frozenset(event["vehicle"] for event in events(folder, "entered") if event["t_s"] <= t_s)


def check_planning(
    folder: Path,
    forger: Forger,
    delays: list[float],
    excused: frozenset[str] = frozenset(),
) -> None:
    """Check that planning goes on, and that it sorts all vehicles that were not named."""
    assert max(delays) <= RECOVERY_S, delays
    assert off_lane(folder) <= forger.named | excused


@pytest.mark.full
def test_a_minute_of_all_absurd_messages_delays_planning_by_at_most_two_seconds(
    lab: Lab, road: Path
) -> None:
    with running(lab, road, "--duration", "145", "--pace", 2.0) as (forger, folder):
        forged = forge(forger, ALL)
        watch()

    assert forged.messages >= 50 * MINUTE_S
    check_planning(folder, forger, delays_s(folder, forger, forged))


# --- the rolling operation ------------------------------------------------------------------------


def rolling_delays_s(folder: Path, forger: Forger, forged: Forged) -> list[float]:
    """Return the time from the last forged message, or a snapshot, to the plan of each slot due.

    A plan is due if the snapshot for it is made at most `WATCHED_S` after the last forged message,
    and its slot begins at least `RECOVERY_S` after that message. A slot for which no vehicle moves
    has a plan, but no ballot comes into force.
    """
    ended_s = forger.clock_s(forged.ended_s)
    slots = range(
        math.ceil(forged.began_s / SLOT_S), math.ceil((forged.ended_s + SLOT_S) / SLOT_S) + 3
    )
    made = {event["slot"]: event for event in events(folder, "stream-planned")}
    in_force = {event["slot"]: event["t_s"] for event in events(folder, "plan-in-force")[::-1]}
    delays = []
    for slot in slots:
        snapshot_s = (slot - 1) * SLOT_S + SNAPSHOT_S
        if (
            forger.clock_s(slot * SLOT_S) < ended_s + RECOVERY_S
            or forger.clock_s(snapshot_s) > ended_s + WATCHED_S
        ):
            continue
        moves = slot not in made or made[slot]["ballots"] > 0
        planned_s = in_force.get(slot, math.inf) if moves else made[slot]["t_s"]
        delays.append(_delay_s(forger, forged, snapshot_s, planned_s))
    return delays


@pytest.mark.full
def test_a_minute_of_all_absurd_messages_in_the_rolling_operation(lab: Lab) -> None:
    road = lab.path("absurd.toml", f"{ROAD}{ROLLING}")
    with running(lab, road, "--duration", "145", "--pace", 2.0) as (forger, folder):
        forged = forge(forger, [row for row in ALL if row not in OUTBIDDING])
        watch()

    assert forged.messages >= 50 * MINUTE_S
    check_planning(folder, forger, rolling_delays_s(folder, forger, forged))


# --- a secured network ----------------------------------------------------------------------------

FAULTY, OTHER = "fleet.agents-1", "fleet.agents-2"


@pytest.mark.full
@pytest.mark.parametrize("own", [False, True], ids=["others", "own"])
def test_a_minute_of_all_absurd_messages_from_a_process_with_a_certificate(
    lab: Lab, own: bool
) -> None:
    """A faulty process of agents knows all messages, but it can only send those of its vehicles."""
    text = f'{ROAD}{SMALL_FORMATIONS}{SECURED_DEMAND}[network]\nrealm = "{REALM}"\n'
    endpoint = f'endpoint = "{LINKS[0].format(free_port())}"\n'
    config = lab.path("deployment.toml", text + endpoint + SECURITY)
    assert lab.run("certs", "init", "certs", "--config", config).status == 0
    network = Network(lab.folder / "certs", load_scenario(config))
    folder = lab.folder / "out"
    router = start_router(lab, config)
    roles = [
        lab.start("coordinator", "--config", config, "--name", "c1"),
        lab.start("coordinator", "--config", config, "--name", "c2"),
        lab.start("agent", "--config", config, "--fleet", "agents-1"),
        lab.start("agent", "--config", config, "--fleet", "agents-2"),
    ]
    bridge = lab.start("bridge", "--config", config, "--pace", "2", "--out", folder)
    lab.wait_until(lambda: len(events(folder, "plan-in-force")) > 0)
    forger = Forger(
        network.access(FAULTY),
        [network.access(each) for each in ("bridge", "coordinator.c3", FAULTY, OTHER)],
        lambda vehicle: Shard(0, 2).contains(vehicle) == own,
    )
    with closing(forger):
        forged = forge(forger, ALL)
        watch()
    ended = lab.finish(bridge, RUN_S)
    assert (ended.status, ended.complaints) == (0, []), ended
    stop(lab, *roles)
    stop(lab, router)
    check_safe_and_complete(folder)

    assert forged.messages >= 50 * MINUTE_S
    if own:
        assert summary(folder)["messages"]["rejected"] > 0
    else:
        # No process has received any of the messages.
        assert summary(folder)["messages"]["rejected"] == 0
        assert off_lane(folder) == set()
    check_planning(folder, forger, delays_s(folder, forger, forged))


# --- floods ---------------------------------------------------------------------------------------


@pytest.mark.full
def test_a_flood_changes_the_leader_at_most_once(lab: Lab, road: Path) -> None:
    """Of messages that are costly to refuse, on the keys that all coordinators read."""

    def ignore(_: Delivery) -> None:
        pass

    floods: list[tuple[type[Message], str]] = [
        (RoadClock, KEYS.key(CLOCK)),
        (Heartbeat, KEYS.key(HEARTBEAT, coordinator="c1")),
        (Heartbeat, KEYS.key(HEARTBEAT, coordinator="zz")),
    ]
    with running(lab, road, "--duration", "20", "--pace", 2.0) as (forger, folder):
        # A client that receives its own junk would be too slow to send it.
        forger.close()
        transport = ZenohTransport(forger.access, ignore)
        junk = []
        for kind, key in floods:
            body = [2 * HUGE] * len(fields(kind))
            junk.append((key, msgpack.packb([VERSION, kind.__name__, body])))
        began_s, sent = time.monotonic(), 0
        while sent < FLOOD:
            for key, payload in junk * 100:
                transport.publish(key, payload, Quality.LATEST)
            sent += 100 * len(junk)
            time.sleep(max(0.0, began_s + sent * FLOOD_S / FLOOD - time.monotonic()))
        transport.close()

    assert leader_changes(folder) <= 1
