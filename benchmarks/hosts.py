"""Faults in a deployment on several hosts: tables of docs/FAULTS.md and docs/DEPLOYMENT.md.

    python benchmarks/hosts.py [--only NAME ...] [--losses] [--link LINK] [--short] [--pace P]
                               [--out FOLDER]

Each experiment is one run of the deployment of compose.yaml, as processes on hosts that are network
namespaces (tests/support/hosts.py). A link is cut, or a service is killed and restarted with the
same command; with `--losses`, all links lose or delay packets. Roles start before their router.
Figures are read from the run's folder and written to FOLDER/hosts.json, or FOLDER/links.json.
Finished experiments are kept, unless `--only` names them. The exit status is 1 if bodies
overlapped, a run did not finish, or a process failed. The script needs permission to create network
namespaces.
`--link`: protocol and options of endpoints, such as `quic?mixed_rel=1`; `tcp` and `udp` are without
certificates. `--short`: vehicles arrive for 20 s instead of 90 s.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import signal
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from attrs import frozen

from experiments import run_missing
from laneweave.launch.faults.network_namespaces import PERFECT, Link
from laneweave.launch.recordings.events import read_events
from laneweave.protocol.wire.events import AGENT_TOOK_OVER, CARETAKER_TOOK_OVER, LEFT

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from support.hosts import APART, Hosts, compose, lasts, open_hosts

LONGEST_S = 600.0
"""Upper bound on the duration of a run, in wall-clock seconds."""
DURATION_S, SHORT_S = 90.0, 20.0
"""Duration of the arrivals."""
BEGIN_S = 40.0
"""Road time of the fault: vehicles enter and change lanes, and none has left yet."""
OUTAGES, OUTAGE_S, BETWEEN_S = 20, 5.0, 1.0
"""Number of outages of one link, duration of each, and time after each recovery [s]."""
MAX_BACK_S = 20.0
"""Upper bound on the time until agents are back."""
AWAY_S = 3.0
"""Wall-clock time until a killed service is restarted."""
SERVICES = tuple(name for name, service in compose()["services"].items() if lasts(service))


@frozen
class Experiment:
    """A run with a fault."""

    name: str
    text: str
    """Description of the fault, for the table."""
    disturb: Callable[[Hosts], list[float] | None]
    """Disturb a run; return how long each disturbance lasted beyond its end [s], if measured."""
    loss: Link = PERFECT
    """Of all links during the whole run."""
    apart: bool = False
    """Whether the second agents process has a link of its own."""


def nothing(_: Hosts) -> None:
    """Do not disturb the deployment."""


def cut(host: str, for_s: float) -> Experiment:
    """Return an experiment that cuts a host's link."""

    def disturb(hosts: Hosts) -> None:
        hosts.partition(host, for_s)

    return Experiment(
        f"{host}-cut-{for_s:g}-s", f"link of the {host} host cut for {for_s:g} s", disturb
    )


def killed(name: str) -> Experiment:
    """Return an experiment that kills a service and restarts it."""

    def disturb(hosts: Hosts) -> None:
        hosts.kill(name)
        time.sleep(AWAY_S)
        hosts.start(name)

    return Experiment(
        f"{name}-killed", f"{name} killed, and started again after {AWAY_S:g} s", disturb
    )


def outages(hosts: Hosts) -> list[float]:
    """Cut one agents process off again and again; return the times until its agents are back."""
    back_s = []
    for _ in range(OUTAGES):
        hosts.partition(APART, OUTAGE_S)
        began_s = time.monotonic()
        while (unattended := _unattended(hosts)) and time.monotonic() < began_s + MAX_BACK_S:
            time.sleep(0.02)
        back_s.append(math.inf if unattended else time.monotonic() - began_s)
        time.sleep(BETWEEN_S)
    return back_s


def _unattended(hosts: Hosts) -> set[str]:
    """Return the vehicles on the road with a caretaker in charge."""
    unattended: set[str] = set()
    for event in read_events(hosts.runs[-1], CARETAKER_TOOK_OVER, AGENT_TOOK_OVER, LEFT):
        if event["kind"] == CARETAKER_TOOK_OVER:
            unattended.add(event["vehicle"])
        elif event["kind"] in (AGENT_TOOK_OVER, LEFT):
            unattended.discard(event["vehicle"])
    return unattended


UNDISTURBED = Experiment("undisturbed", "nothing", nothing)
FAULTS = (
    UNDISTURBED,
    *(
        cut(host, for_s)
        for for_s in (5.0, 30.0)
        for host in ("vehicles", "coordinators", "simulation")
    ),
    *(killed(name) for name in SERVICES),
    Experiment(
        "outages",
        f"link of agents-2 cut for {OUTAGE_S:g} s, {OUTAGES} times",
        outages,
        apart=True,
    ),
)
LOSSES = (
    UNDISTURBED,
    *(
        Experiment(f"loss-{percent}", f"{percent} %", nothing, Link(loss=percent / 100))
        for percent in (2, 10, 25)
    ),
    *(
        Experiment(f"delay-{ms}", f"0 %, {ms} ms", nothing, Link(delay_s=ms / 1000))
        for ms in (20, 50)
    ),
    Experiment(
        "bursts-10", "10 %, 20 successive packets each time", nothing, Link(loss=0.1, burst=20)
    ),
)


def run(
    experiment: Experiment, folder: Path, duration_s: float, pace: float, link: str
) -> dict[str, Any]:
    """Run an experiment and return its figures."""
    folder.mkdir(parents=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    demand = {"duration_s": duration_s}
    options: dict[str, Any] = {
        "pace": pace,
        "link": link,
        "apart": experiment.apart,
        "delayed": experiment.loss.delay_s > 0.0,
    }
    with open_hosts(folder, **options, demand=demand) as hosts:
        hosts.start_all(experiment.loss)
        hosts.wait_road(BEGIN_S, LONGEST_S)
        began = time.monotonic()
        back_s = experiment.disturb(hosts) or []
        lasted_s = time.monotonic() - began
        bridge = hosts.finish("bridge", LONGEST_S)
        # Services that still run exit on request; a negative status means that the process died.
        statuses = hosts.stop(*[name for name in hosts.running if name != "router"], "router")
        (*_, last) = hosts.runs
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = figures(last)
    return {
        "text": experiment.text,
        "link": link,
        "cpu_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
        "bridge_status": bridge,
        "ended_badly": sorted(name for name, status in statuses.items() if status != 0),
        "disturbed_s": round(lasted_s, 1),
        "back_s": [round(each, 2) for each in back_s],
    } | found


def figures(folder: Path) -> dict[str, Any]:
    """Return the figures of a run's folder."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    trips = pq.read_table(folder / "trips.parquet").to_pylist()
    times = [trip["travel_time_s"] for trip in trips if trip["left_s"] is not None]
    vehicles, safety = summary["vehicles"], summary["safety"]
    return {
        "ending": summary["ending"],
        "overlaps": safety["overlaps"],
        "sumo_collisions": safety["sumo_collisions"],
        "min_gap_m": safety["min_gap_m"],
        "demanded": vehicles["demanded"],
        "left": vehicles["left"],
        "on_lane_percent": 100.0 * vehicles["on_preferred_lane"] / max(1, vehicles["left"]),
        "travel_time_s": statistics.fmean(times) if times else None,
        "leader_changes": summary["failover"]["leader_changes"],
        "caretakers": len(list(read_events(folder, CARETAKER_TOOK_OVER))),
        "real_time_factor": summary["runtime"]["real_time_factor"],
        "tick_ms_p50": summary["runtime"]["tick_ms"]["p50"],
        "tick_ms_p99": summary["runtime"]["tick_ms"]["p99"],
        "missed_ticks": summary["tracking"]["missed_ticks"],
    }


def kept_promises(found: dict[str, Any]) -> bool:
    """Return whether no vehicles touched, all arrived, and all processes ended normally."""
    touched = found["overlaps"] or found["sumo_collisions"]
    complete = found["ending"] == "complete" and found["left"] == found["demanded"] > 0
    return complete and not touched and found["bridge_status"] == 0 and not found["ended_badly"]


def main() -> int:
    """Run the requested experiments."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    names = [one.name for one in (*FAULTS, *LOSSES[1:])]
    parser.add_argument("--only", nargs="+", choices=names)
    parser.add_argument("--losses", action="store_true", help="bad links instead of faults")
    parser.add_argument("--link", default="tls", help="protocol and options of endpoints")
    parser.add_argument("--short", action="store_true", help="fewer arrivals")
    parser.add_argument("--pace", type=float, help="road seconds per second")
    parser.add_argument("--out", type=Path, default=Path("runs/hosts"), help="folder")
    arguments = parser.parse_args()
    # On SIGTERM, exit normally so that all started processes are stopped.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    options = {
        "duration_s": SHORT_S if arguments.short else DURATION_S,
        "pace": arguments.pace or (1.0 if arguments.losses else 3.0),
        "link": arguments.link,
    }
    if arguments.losses:
        runs = {f"{arguments.link} {one.name}": partial(run, one, **options) for one in LOSSES}
        record = arguments.out / "links.json"
    else:
        runs = {one.name: partial(run, one, **options) for one in FAULTS}
        record = arguments.out / "hosts.json"
    only = arguments.only
    if only and arguments.losses:
        only = [f"{arguments.link} {name}" for name in only]
    found = run_missing(runs, only, record)
    return 0 if all(map(kept_promises, found)) else 1


if __name__ == "__main__":
    sys.exit(main())
