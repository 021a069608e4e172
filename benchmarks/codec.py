"""CPU time and bytes of the three messages of a vehicle and tick: `python benchmarks/codec.py`.

SENSE, COMMAND and STATE of a vehicle of a formation that moves beside others, with jerks for 6 s.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable

from laneweave.protocol.wire.codec import decode, encode
from laneweave.protocol.wire.messages import (
    Ballot,
    Command,
    CurrentMotion,
    Name,
    Neighbour,
    Sense,
    VehicleRecord,
    VehicleState,
)

ROUNDS, REPEATS = 15, 2_000
NOW_NS = 1_790_000_000_000_000_000
"""A time at which processes start: incarnations take 9 bytes."""
VEHICLE, BALLOT = Name("v0012"), Ballot(3, Name("c1"), NOW_NS, 7)
RECORD = VehicleRecord(NOW_NS, (1,), BALLOT, BALLOT)
MOTION = CurrentMotion((-3, 0), 420, 38)
AROUND = tuple(Neighbour(lane, 20.3, 15.21, 0.11) for lane in range(2))
MESSAGES = (
    Sense(
        vehicle=VEHICLE,
        tick=400,
        t_s=40.0,
        measured=(512.31, 15.01, 0.12, 5.63, 0.01, 0.02),
        hold_cell=(-3, 1),
        motion=MOTION,
        preferred_lane=1,
        record=RECORD,
        ahead=AROUND,
        behind=AROUND,
        setpoint=(0.11, 0.02),
        block=1,
        bridge=NOW_NS,
    ),
    Command(VEHICLE, RECORD, 400, (-3, 1), MOTION, bytes(8 * 60)),
    VehicleState(
        VEHICLE,
        1,
        RECORD,
        ready=True,
        completed=1,
        hold_cell=(-3, 1),
        moving=True,
        go=True,
        done=False,
        overdue=False,
        attended=True,
        s_m=512.31,
        y_m=5.63,
        speed_mps=15.01,
        t_s=40.0,
    ),
)


def median_us(work: Callable[[], object]) -> float:
    """Return the median CPU time of a call [us]."""
    times: list[float] = []
    for _ in range(ROUNDS):
        began_s = time.thread_time()
        for _ in range(REPEATS):
            work()
        times.append((time.thread_time() - began_s) / REPEATS * 1e6)
    return statistics.median(times)


def main() -> None:
    """Print the figures."""
    payloads = [(encode(message), type(message)) for message in MESSAGES]
    encode_us = median_us(lambda: [encode(message) for message in MESSAGES])
    decode_us = median_us(lambda: [decode(*payload) for payload in payloads])
    size = sum(len(payload) for payload, _ in payloads)
    sys.stdout.write(f"encode {encode_us:.1f} us, decode {decode_us:.1f} us, {size} bytes\n")


if __name__ == "__main__":
    main()
