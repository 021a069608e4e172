"""Write the generated parts of the documents: `python docs/generate.py`.

A generated part stands between `<!-- begin NAME -->` and `<!-- end NAME -->`; a test compares it
with the output of this script. The script also draws the pictures of the conflict table and of the
solution of the case study.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import sys
from collections.abc import Iterable, Iterator
from enum import Enum
from functools import cache
from operator import itemgetter
from pathlib import Path
from statistics import fmean
from types import ModuleType
from typing import Any

if __name__ == "__main__":  # same paths as `pythonpath` in pyproject.toml
    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))


from attrs import fields_dict

import laneweave
import radio
import roads
import surprises
from api_reference import api_reference, documented
from command_reference import command_reference
from conflict_drawing import counts, draw_conflicts
from evaluation.evidence import read_evidence
from evaluation.markdown import markdown
from evaluation.tables import document_parts
from experiments import P
from laneweave import methods, planners
from laneweave.agents.host import AgentMetrics
from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.core import CoordinatorMetrics
from laneweave.coordinator.formations.leader import LEADER_RULES
from laneweave.coordinator.planning.paper.explanation import explain
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.process import SolverMetrics
from laneweave.coordinator.rolling.transfer import TRANSFER_RULES
from laneweave.coordinator.service.server import ServiceMetrics
from laneweave.launch.drawing.tappa_process import draw_explanation
from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.launch.observe.findings import RULES, FindingsMetrics
from laneweave.launch.observe.metrics_server import PROCESS, PROCESS_MEANING
from laneweave.launch.recordings.results_over_seeds import RESULTS
from laneweave.launch.studies.sensitivity import Result
from laneweave.launch.studies.sensitivity_page import HEADINGS, result_row
from laneweave.protocol.radio.radio_core import RadioMetrics
from laneweave.protocol.runtime.metrics import (
    MetricsSnapshot,
    NodeMetrics,
    RouterMetrics,
    metrics_of,
)
from laneweave.protocol.runtime.settings_check import SettingsMetrics
from laneweave.protocol.security.access_control import READING, SENDING, Flow, rights_on
from laneweave.protocol.state_machine import Function, RuleBook
from laneweave.protocol.summary import described
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from laneweave.protocol.vehicle.plan_execution import ExecutionPhase
from laneweave.protocol.wire import events, messages, obstacle_messages, process_messages
from laneweave.protocol.wire.common_settings import GROUPS, groups_of
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.topics import TOPICS, Exchange, Party, Topic
from laneweave.sim_bridge.core import BridgeMetrics
from laneweave.sim_bridge.recording.columns import TICKS, TRAJECTORIES, TRIPS, Table
from scenario_reference import meanings_in, scenario_table
from support.bugs import Bug
from support.planted_bugs import BUGS
from support.road_bugs import ROAD_BUGS
from support.unseen_bugs import UNSEEN

DOCS = Path(__file__).resolve().parent
FOUND = DOCS / "evidence" / "planted-bugs-found.json"
"""Output of `tests/simulation/search_bugs.py`."""
CAUGHT = DOCS / "evidence" / "kill_matrix.json"
"""Output of `tests/simulation/kill_matrix.py`."""
MEASURED = DOCS / "evidence" / "resilience.json"
"""Output of `benchmarks/resilience.py`."""
PLANNED = DOCS / "evidence" / "planner.json"
"""Output of `laneweave bench planner --json`."""
SWITCHES = DOCS / "evidence" / "planner-switches.json"
"""Output of `benchmarks/planner_switches.py`."""
GEOMETRY = DOCS / "evidence" / "geometry.json"
"""Output of `benchmarks/geometry.py`."""
CLOSING = DOCS / "evidence" / "closing.json"
"""Output of `benchmarks/closing.py`."""
STREAM = DOCS / "evidence" / "stream.json"
"""Output of `benchmarks/stream.py`."""
ROADS = DOCS / "evidence" / roads.RECORD
"""Output of `benchmarks/roads.py`."""
HOSTS = DOCS / "evidence" / "hosts.json"
LINKS = DOCS / "evidence" / "links.json"
"""Output of `benchmarks/hosts.py`."""
SERVICE = DOCS / "evidence" / "service.json"
"""Output of `benchmarks/service.py`."""
EVALUATED = DOCS / "evidence" / "evaluation.json"
"""Output of `benchmarks/evaluate.py`."""
LONG = DOCS / "evidence" / "long-run.json"
"""Memory of long runs, by `benchmarks/long_run.py`."""
STABILITY = DOCS / "evidence" / "stability.json"
"""Output of `benchmarks/stability.py`."""
SENSITIVITY = DOCS / "evidence" / "sensitivity.json"
"""Output of `laneweave sensitivity`."""
SURPRISES = DOCS / "evidence" / surprises.RECORD
"""Output of `benchmarks/surprises.py`."""
DECISIONS = DOCS / "adr"
SCENARIO = DOCS / "SCENARIO.md"
CONFLICTS = DOCS / "images" / "conflict-table.png"
CASE = DOCS / "examples" / "case-study.json"
SOLVING = DOCS / "images" / "solving-process.png"
SNAPSHOTS: dict[type[MetricsSnapshot], str] = {
    NodeMetrics: "every role but the router",
    CoordinatorMetrics: "coordinator",
    ServiceMetrics: "coordinator",
    SolverMetrics: "coordinator",
    AgentMetrics: "agent",
    BridgeMetrics: "bridge",
    RouterMetrics: "router",
    SettingsMetrics: "coordinator, agent",
    RadioMetrics: "coordinator, agent, bridge",
    FindingsMetrics: "watch, at its own address",
}
"""Classes of metrics, each with the role that serves them."""


_VERBS = {
    Exchange.MESSAGES: ("sends", "reads"),
    Exchange.TOKENS: ("declares", "watches"),
    Exchange.QUERIES: ("queries", "serves"),
}
_PARTIES = (
    Party.BRIDGE,
    Party.COORDINATOR,
    Party.VEHICLE,
    Party.FLEET,
    Party.CLIENT,
    Party.OPERATOR,
    Party.OBSERVER,
)


def rights_table() -> str:
    """Return the table of rights for DEPLOYMENT.md."""
    lines = ["| certificate | may |", "|---|---|"]
    for party in _PARTIES:
        identity = Identity(party, "" if party is Party.BRIDGE else "NAME")
        does = "<br>".join(_rights_of(identity))
        lines.append(f"| `{identity.common_name}` | {does} |")
    return "\n".join(lines)


def _rights_of(identity: Identity) -> Iterator[str]:
    if identity.party is Party.FLEET:
        yield "all rights of each of its vehicles, with its own name as that of the process"
    for exchange, verbs in _VERBS.items():
        topics = [topic for topic in TOPICS if topic.exchange is exchange]
        for verb, rights in zip(verbs, (SENDING[exchange], READING[exchange]), strict=True):
            keys = dict.fromkeys(_keys_of(topics, identity, rights[0]))
            if keys:
                yield f"{verb} " + ", ".join(f"`{key}`" for key in keys)


def _keys_of(
    topics: Iterable[Topic], identity: Identity, wanted: tuple[Flow, str]
) -> Iterator[str]:
    for topic in topics:
        for right, parameters in rights_on(topic, identity.party, identity.name, identity.name):
            if right == wanted:
                shown = dict.fromkeys(topic.parameters, "*") | parameters
                yield topic.pattern.format_map(shown)


def _meaning(function: Function) -> str:
    """Return what a guard or an action means: the first line of its docstring."""
    text = inspect.getdoc(function) or function.__name__
    return text.splitlines()[0].rstrip(".")


def _rule_table(book: RuleBook) -> str:
    """Return the table of a book."""
    lines = ["| rule | event | in phase | guard | action | then |", "|---|---|---|---|---|---|"]
    for row in book.table:
        every = set(row.sources) == set(type(row.sources[0]))
        phases = "any" if every else ", ".join(str(phase.value) for phase in row.sources)
        guards = "; ".join(map(_meaning, row.guards))
        actions = "; ".join(map(_meaning, row.actions)) or "nothing"
        target = row.target.value if row.target is not None else ""
        lines.append(f"| {row.rule} | {row.event} | {phases} | {guards} | {actions} | {target} |")
    return "\n".join(lines)


def _phase_diagram(book: RuleBook, start: Enum) -> str:
    """Return the diagram of the phases of a book."""
    lines = ["stateDiagram-v2", f"  [*] --> {_node(start)}"]
    arrows: dict[tuple[Enum, Enum], list[str]] = {}
    for row in book.table:
        for source in row.sources:
            if row.target is not None and row.target is not source:
                labels = arrows.setdefault((source, row.target), [])
                label = f"{row.rule} {row.event}"
                if label not in labels:
                    labels.append(label)
    for (source, target), labels in arrows.items():
        lines.append(f"  {_node(source)} --> {_node(target)}: {', '.join(labels)}")
    return "```mermaid\n" + "\n".join(lines) + "\n```"


def _node(phase: Enum) -> str:
    return str(phase.value).replace(" ", "_").replace("-", "_")


def _topics() -> str:
    """Return the table of topics, keys and readers."""
    lines = [
        "| Topic | Key | Message | Sender | Quality | Reliable | Readers | Remark |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for topic in TOPICS:
        message = "none" if topic.kind is None else f"`{topic.kind.__name__}`"
        sender = f"{topic.sender}, {topic.deputy} in its place" if topic.deputy else topic.sender
        own = ["the process of the key"] if topic.addressed else []
        lines.append(
            f"| `{topic.name}` | `{topic.pattern}` | {message} | {sender} "
            f"| `{topic.quality.name}` | {'yes' if topic.reliable else 'no'} "
            f"| {', '.join([*own, *topic.readers])} | {topic.remark} |"
        )
    return "\n".join(lines)


def _messages() -> str:
    """Return a section for each message class: its docstring and a table of its fields."""
    sections = []
    modules = messages, obstacle_messages, process_messages
    for node in (node for module in modules for node in _syntax(module).body):
        if isinstance(node, ast.ClassDef):
            lines = [f"### {node.name}\n\n{ast.get_docstring(node)}\n"]
            lines += ["| Field | Meaning |", "|---|---|"]
            lines += [f"| `{name}` | {text} |" for name, text in documented(node)]
            sections.append("\n".join(lines))
    return "\n\n".join(sections)


def _settings() -> str:
    """Return the rows of the table of settings that must agree."""
    lines = ["| group | settings | compared by |", "|---|---|---|"]
    lines += [
        f"| {group} | {', '.join(f'`{name}`' for name in names)} "
        f"| {'all roles' if group in groups_of('agent') else 'coordinators'} |"
        for group, names in GROUPS.items()
    ]
    return "\n".join(lines)


def _findings() -> str:
    """Return the rows of the table of rules."""
    lines = ["| rule | what is found | what to do |", "|---|---|---|"]
    for one in RULES:
        about = (one.find.__doc__ or "").partition("\n")[0].removesuffix(".")
        lines.append(f"| `{one.name}` | {about} | {one.advice} |")
    return "\n".join(lines)


def _events() -> str:
    """Return the table of events that roles log."""
    lines = ["| Event | Meaning |", "|---|---|"]
    for name, text in documented(_syntax(events)):
        if isinstance(getattr(events, name), str):
            lines.append(f"| `{getattr(events, name)}` | {text} |")
    return "\n".join(lines)


def _columns(table: Table) -> str:
    """Return the table of a Parquet file's columns."""
    lines = ["| column | type | unit | frame | meaning |", "|---|---|---|---|---|"]
    lines += [
        f"| `{one.name}` | {one.type} | {one.unit} | {one.frame} | {one.meaning} |"
        for one in table.columns
    ]
    return "\n".join(lines)


def _summary_fields() -> str:
    """Return the table of the fields of summary.json."""
    lines = ["| field | unit | meaning |", "|---|---|---|"]
    lines += [f"| `{path}` | {unit} | {meaning} |" for path, unit, meaning in described()]
    return "\n".join(lines)


def _event_fields() -> str:
    """Return the data of each kind of event, and the meaning of each field."""
    lines = ["| `kind` | data |", "|---|---|"]
    for kind, names in events.FIELDS.items():
        lines.append(f"| `{kind}` | {', '.join(f'`{name}`' for name in names)} |")
    lines += ["", "| key | meaning |", "|---|---|"]
    lines += [f"| `{name}` | {meaning} |" for name, meaning in events.MEANINGS.items()]
    return "\n".join(lines)


def _syntax(module: ModuleType) -> ast.Module:
    return ast.parse(inspect.getsource(module))


def _decisions() -> str:
    """Return the list of decisions: the titles of their pages, numbered."""
    titles = {
        path: path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
        for path in sorted(DECISIONS.glob("[0-9]*.md"))
    }
    return "\n".join(
        "{}. [{}](adr/{})".format(*title.split(". ", 1), path.name)
        for path, title in titles.items()
    )


def _scenario_fields() -> str:
    """Return the table of scenario fields, with the meanings that the document has now."""
    return scenario_table(meanings_in(SCENARIO.read_text(encoding="utf-8")))


def _planted_bugs() -> str:
    """Return the table of planted bugs."""
    found = json.loads(FOUND.read_text(encoding="utf-8"))["found"]
    lines = [
        "| planted bug | rule | what is broken | caught by | outcome | random search |",
        "|---|---|---|---|---|---|",
    ]
    for bug in BUGS:
        end = "two vehicles in one cell" if bug.collides else "another error, or a vehicle waits"
        seed = found.get(bug.name, "-")
        lines.append(
            f"| `{bug.name}` | {bug.rule} | {bug.text} | {_caught_by(bug)} | {end} | {seed} |"
        )
    return "\n".join(lines)


def _unseen_bugs() -> str:
    """Return the table of planted bugs for which neither scenarios nor search were written."""
    found = json.loads(FOUND.read_text(encoding="utf-8"))["found"]
    lines = [
        "| planted bug | rule | what is broken | caught by | random search |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| `{bug.name}` | {bug.rule} | {bug.text} | {_caught_by(bug)} | "
        f"{found.get(bug.name, '-')} |"
        for bug in UNSEEN
    ]
    return "\n".join(lines)


def _road_bugs() -> str:
    """Return the table of planted bugs of lane ends, ramps and exits."""
    lines = ["| planted bug | part | what is broken | caught by |", "|---|---|---|---|"]
    lines += [
        f"| `{bug.name}` | {bug.rule} | {bug.text} | {_caught_by(bug)} |" for bug in ROAD_BUGS
    ]
    return "\n".join(lines)


def _caught_by(bug: Bug) -> str:
    """Return the test that catches a bug, and its target if that is not `make test`."""
    caught = json.loads(CAUGHT.read_text(encoding="utf-8"))[bug.name]
    if bug.scenario:
        return f"`{bug.scenario}`"
    for target, suffix in (("test", ""), ("more", " (`make test-more`)")):
        if caught[target]:
            return f"`{caught[target][0].removeprefix('tests/')}`{suffix}"
    return "-"


def _caught_bugs() -> str:
    """Return the number of planted bugs that tests catch, by target of the Makefile."""
    caught = json.loads(CAUGHT.read_text(encoding="utf-8"))
    lines = ["| planted bugs | caught by `make test` | by `make test-more` only |", "|---|---|---|"]
    kinds = (
        ("with a scenario", BUGS), ("unseen", UNSEEN), ("of lane ends, ramps and exits", ROAD_BUGS)
    )  # fmt: skip
    for text, bugs in (*kinds, ("in all", [*BUGS, *UNSEEN, *ROAD_BUGS])):
        entries = [caught[bug.name] for bug in bugs]
        quick = sum(bool(entry["test"]) for entry in entries)
        later = sum(bool(entry["more"]) and not entry["test"] for entry in entries)
        lines.append(f"| {len(bugs)} {text} | {quick} | {later} |")
    return "\n".join(lines)


def _found_bugs() -> str:
    """Return the number of planted bugs that the random search finds."""
    recorded = json.loads(FOUND.read_text(encoding="utf-8"))
    lines = ["| planted bugs | found by the random search |", "|---|---|"]
    for text, bugs in (("with a scenario", BUGS), ("unseen", UNSEEN)):
        count = sum(recorded["found"].get(bug.name, "-") != "-" for bug in bugs)
        lines.append(f"| {len(bugs)} {text} | {count} ({count / len(bugs):.0%}) |")
    lines.append(f"| seeds for each bug | at most {recorded['seeds']} |")
    return "\n".join(lines)


def _profiles() -> str:
    """Return the table of the profiles of `laneweave simulate`."""
    lines = ["| `--profile` | what goes wrong |", "|---|---|"]
    lines += [f"| `{profile.name}` | {profile.text} |" for profile in PROFILES.values()]
    return "\n".join(lines)


def _resilience() -> str:
    """Return the table of the cost of faults, by `benchmarks/resilience.py`."""
    measured = json.loads(MEASURED.read_text(encoding="utf-8"))
    lines = [
        (
            "| experiment | left the road | in their lane | overlaps | min. gap | travel time "
            "| remarks |"
        ),
        "|---|---|---|---|---|---|---|",
    ]
    for name, run in measured.items():
        prefix = "rolling-" if name.startswith("rolling-") else ""
        calm = measured[f"{prefix}undisturbed"]
        comparable = run["demanded"] == calm["demanded"]
        factor = run["travel_time_s"] / calm["travel_time_s"]
        times = f" ({factor:.3f}x)" if comparable else ""
        lines.append(
            f"| `{name}` | {run['left']} of {run['demanded']} | {run['on_lane_percent']:.1f} % "
            f"| {run['overlaps']} | {run['min_gap_m']:.2f} m | {run['travel_time_s']:.2f} s{times} "
            f"| {'; '.join(_more(name, run))} |"
        )
    return "\n".join(lines)


def _more(name: str, run: dict[str, Any]) -> Iterator[str]:
    """Yield the remarks on one experiment."""
    if run["dropped"]:
        yield f"{run['dropped']:,} messages lost"
    taken_over = run["events"].get("caretaker-took-over", 0)
    if taken_over:
        yield f"caretakers took over {taken_over} times"
    if taken_over and run["others"]:
        share = run["others_on_lane_percent"]
        yield f"of {run['others']} that never had one {share:.1f} % in their lane"
    for key, words in (("leader_recovery_s", "another leader"), ("plan_recovery_s", "next plan")):
        times = run[key]
        if times["count"]:
            yield f"{words} after {times['p50']:.2f} s (p50), {times['p99']:.2f} s (p99)"
    if (planned_s := run.get("planned_after_s")) is not None:
        yield f"{run['stopped']} stopped, first plan around the vehicle after {planned_s:.2f} s"
    if run["replanned"]:
        yield f"{run['replanned']} repeated plans"
    if not name.startswith("rolling-"):  # these have no real time
        yield f"real-time factor {run['real_time_factor']:.2f}"


def _planner() -> str:
    """Return the table of the results of `laneweave bench planner`."""
    lines = [
        "| conflicts | vehicles | proven in 4 s | CPU ms p50 / p95 | gap p50 / max | by 0.1 s |",
        "|---|---|---|---|---|---|",
    ]
    for row in json.loads(PLANNED.read_text(encoding="utf-8"))["results"]:
        cpu, gap = row["cpu_ms"], row["gap_percent"]
        of = f"of {row['instances']}"
        lines.append(
            f"| {row['family']} | {row['vehicles']} | {row['optimal']} {of} "
            f"| {cpu['p50']:.1f} / {cpu['p95']:.1f} | {gap['p50']:.1f} / {gap['max']:.1f} % "
            f"| {row['answered_in_100_ms']} {of} |"
        )
    return "\n".join(lines)


def _switches() -> str:
    """Return the table of the effect of TAPPA's improvements."""
    lines = [
        "| family | improvements | proven in 4 s | CPU ms p50 / p95 / max |",
        "|---|---|---|---|",
    ]
    for row in json.loads(SWITCHES.read_text(encoding="utf-8"))["results"]:
        times = " / ".join(f"{row[f'cpu_ms_{name}']:.1f}" for name in ("p50", "p95", "max"))
        solved = f"{row['solved']} of {row['instances']}"
        lines.append(f"| {row['family']} | {row['improvements']} | {solved} | {times} |")
    return "\n".join(lines)


def _conflicts() -> str:
    """Return the table of the number of forbidden pairs of moves."""
    lines = ["| conflicts | pairs in mode 1 | pairs in mode 2 |", "|---|---|---|"]
    lines += [f"| {name} | {one} | {two} |" for name, one, two in counts()]
    return "\n".join(lines)


def _distances() -> str:
    """Return the table of minimum distances in permitted moves, by `benchmarks/geometry.py`."""
    table = json.loads(GEOMETRY.read_text(encoding="utf-8"))["nearest_m"]
    late = list(table[0])[1:]
    columns = " | ".join(f"one up to {name} late" if name != "0 s" else "on time" for name in late)
    lines = [f"| conflicts | {columns} |", "|---" * (len(late) + 1) + "|"]
    for row in table:
        gaps = " | ".join(f"{row[name]:.2f} m" for name in late)
        lines.append(f"| {row['conflicts']} | {gaps} |")
    return "\n".join(lines)


def _geometry() -> str:
    """Return the table of cost and benefit of conflict tables, by `benchmarks/geometry.py`."""
    lines = [
        "| vehicles | `geometric` | steps of all | cheaper | proven | CPU ms p50 / p95 |",
        "|---|---|---|---|---|---|",
    ]
    for row in json.loads(GEOMETRY.read_text(encoding="utf-8"))["results"]:
        of = f"of {row['instances']}"
        lines.append(
            f"| {row['vehicles']} | {row['conflicts']} | {row['cost']} | {row['cheaper']} {of} "
            f"| {row['proven']} {of} | {row['cpu_ms_p50']:.1f} / {row['cpu_ms_p95']:.1f} |"
        )
    return "\n".join(lines)


def _closing() -> str:
    """Return the table of the cost of `closing` conflicts, by `benchmarks/closing.py`."""
    lines = [
        (
            "| conflicts | vehicles | closes up | steps | more expensive | additional steps "
            "| CPU ms p50 | mean | factor |"
        ),
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in json.loads(CLOSING.read_text(encoding="utf-8")):
        cost, p50_ms, mean_ms = (row[key] for key in ("cost", "cpu_ms_p50", "cpu_ms_mean"))
        of = f"of {row['instances']}"
        lines.append(
            f"| {row['conflicts']} | {row['vehicles']} | {row['closing_up']} {of} "
            f"| {cost[0]}, {cost[1]} | {row['costlier']} {of} "
            f"| {row['more_steps_p50']:g} / {row['more_steps_mean']:.2f} / {row['more_steps_max']} "
            f"| {p50_ms[0]:.1f}, {p50_ms[1]:.1f} | {mean_ms[0]:.1f}, {mean_ms[1]:.1f} "
            f"| {row['cpu_factor_p50']:.2f} |"
        )
    return "\n".join(lines)


def _stream() -> str:
    """Return the table of results of the stream planner, by `benchmarks/stream.py`."""
    lines = [
        (
            "| variant | veh/(lane h) | off their targets | travel time mean / p95 | ramp delay "
            "| columns gained | CPU ms p50 / mean / p99 / max |"
        ),
        "|---|---|---|---|---|---|---|",
    ]
    for row in json.loads(STREAM.read_text(encoding="utf-8")):
        cpu_ms = " / ".join(f"{row[f'cpu_ms_{key}']:.1f}" for key in ("p50", "mean", "p99", "max"))
        off, vehicles = row["off_lane"], row["vehicles"]
        ramp_s = row.get("ramp_delay_s_mean")
        ramp = "" if ramp_s is None else f"{ramp_s:.2f} s"
        lines.append(
            f"| {row['variant']} | {row['volume_veh_per_lane_h']} "
            f"| {off} of {vehicles:,} ({100.0 - row['on_lane_percent']:.2f} %) "
            f"| {row['travel_s_mean']:.2f} / {row['travel_s_p95']:.2f} s "
            f"| {ramp} | {row['drift_columns_mean']:.2f} | {cpu_ms} |"
        )
    return "\n".join(lines)


@cache
def _road_runs() -> list[tuple[roads.Point, list[dict[str, Any]]]]:
    return _measured(roads.POINTS, ROADS)


def _measured(points: Iterable[P], record: Path) -> list[tuple[P, list[dict[str, Any]]]]:
    """Return the measured points of a benchmark, each with its runs by seed."""
    rows = json.loads(record.read_text(encoding="utf-8")).values()
    runs = [
        (point, sorted((row for row in rows if row["point"] == point.name), key=itemgetter("seed")))
        for point in points
    ]
    return [(point, each) for point, each in runs if each]


def _road_results(*, faults: bool) -> str:
    """Return the table of both operations on roads, undisturbed or with faults."""
    lines = [
        (
            f"| road | veh/(lane h) | operation |{' faults |' if faults else ''} runs "
            "| at their destinations | travel time / time at v_F | goal | delay from ramps "
            "| net gap | acceleration | stopped | emergency braking |"
        ),
        "|---" * (13 if faults else 12) + "|",
    ]
    for point, runs in _road_runs():
        if point.label in roads.REFERENCES or point.processes or bool(point.faults) != faults:
            continue
        arrived, left, demanded = (
            sum(run[key] for run in runs) for key in ("at_destination", "left", "demanded")
        )
        reached = f"{arrived:,} of {demanded:,}"
        if left < demanded:
            reached += f", {demanded - left} still on the road"
        goal = "" if point.goal is None else f"{point.goal:g}"
        goal += "" if point.ramp_goal_s is None else f"; {point.ramp_goal_s:g} s"
        low, high = (
            worst(accel[end] for run in runs for accel in run["accel_mps2"].values())
            for end, worst in ((0, min), (1, max))
        )
        ramp_s = _delay_from_ramps_s(runs)
        ramp = "" if ramp_s is None else f"{ramp_s:z.1f} s"
        kind = f" {str(point.faults).removesuffix('.toml')} |" if faults else ""
        lines.append(
            f"| {point.scenario} | {point.volume} | {point.label} |{kind} {len(runs)} "
            f"| {reached} | {fmean(run['ratio'] for run in runs):.3f} | {goal} | {ramp} "
            f"| {min(run['min_gap_m'] for run in runs):.1f} m | {low:.1f} to {high:.1f} m/s2 "
            f"| {sum(run['stopped'] for run in runs)} "
            f"| {sum(run['emergency_ticks'] for run in runs)} ticks |"
        )
    return "\n".join(lines)


def _road_processes() -> str:
    """Return the table of runs over Zenoh, with a process for each vehicle."""
    lines = [
        (
            "| road | veh/(lane h) | processes at once | at their destinations | delay "
            "| net gap | stopped | emergency braking | real-time factor |"
        ),
        "|---" * 9 + "|",
    ]
    for point, (run, *_) in _road_runs():
        if point.processes:
            lines.append(
                f"| {point.scenario} | {point.volume} | {run['processes']} "
                f"| {run['at_destination']} of {run['demanded']} "
                f"| {run['delay_by_entrance_s']['main']:z.2f} s "
                f"| {run['min_gap_m']:.1f} m | {run['stopped']} "
                f"| {run['emergency_ticks']} ticks | {run['real_time_factor']:.2f} |"
            )
    return "\n".join(lines)


def _road_references() -> str:
    """Return the table of the delays of all methods on the same roads, with the first seed."""
    labels = ("rolling", "formations", *roads.REFERENCES)
    lines = [
        f"| road | veh/(lane h) | {' | '.join(labels)} |",
        "|---" * (2 + len(labels)) + "|",
    ]
    cells: dict[tuple[str, int], dict[str, str]] = {}
    for point, (run, *_) in _road_runs():
        if point.faults is None and not point.processes:
            delays_s = [run["delay_by_entrance_s"]["main"], _delay_from_ramps_s([run])]
            text = "; ".join(f"{delay_s:z.1f}" for delay_s in delays_s if delay_s is not None)
            if run["overlaps"]:
                text += f" (overlaps: {run['overlaps']})"
            cells.setdefault((point.scenario, point.volume), {})[point.label] = text
    for (scenario, volume), texts in cells.items():
        if not texts.keys().isdisjoint(roads.REFERENCES):
            row = " | ".join(texts.get(label, "") for label in labels)
            lines.append(f"| {scenario} | {volume} | {row} |")
    return "\n".join(lines)


def _delay_from_ramps_s(runs: list[dict[str, Any]]) -> float | None:
    """Return the mean delay of vehicles from ramps; None if the road has no ramp."""
    delays_s = [
        delay_s
        for run in runs
        for name, delay_s in run["delay_by_entrance_s"].items()
        if name != "main"
    ]
    return fmean(delays_s) if delays_s else None


def _metrics() -> str:
    """Return the table of all metrics with their Prometheus names."""
    lines = [
        "| metric | kind | role | meaning |",
        "|---|---|---|---|",
        f"| `{PROCESS}{{role, name, realm}}` | gauge | every role | {PROCESS_MEANING} |",
    ]
    for kind, role in SNAPSHOTS.items():
        for metric in metrics_of(kind):
            label = f"{{{metric.label}}}" if metric.label else ""
            counts = "counter" if metric.counts else "gauge"
            lines.append(f"| `{metric.name}{label}` | {counts} | {role} | {metric.meaning} |")
    return "\n".join(lines)


def _hosts() -> str:
    """Return the table of faults in a deployment on several hosts, by `benchmarks/hosts.py`."""
    measured = json.loads(HOSTS.read_text(encoding="utf-8"))
    calm_s = measured["undisturbed"]["travel_time_s"]
    lines = [
        (
            "| fault at 40 s | left the road | in their lane | overlaps | min. gap | travel time "
            "| leader changes | caretakers |"
        ),
        "|---|---|---|---|---|---|---|---|",
    ]
    for run in measured.values():
        ended = "" if run["ending"] == "complete" and not run["ended_badly"] else ", not complete"
        time_s = run["travel_time_s"]
        lines.append(
            f"| {run['text']} | {run['left']} of {run['demanded']}{ended} "
            f"| {run['on_lane_percent']:.1f} % | {run['overlaps']} | {run['min_gap_m']:.2f} m "
            f"| {time_s:.2f} s ({time_s / calm_s:.3f}x) | {run['leader_changes']} "
            f"| {run['caretakers']} |"
        )
    return "\n".join(lines)


def _links() -> str:
    """Return the table of links that lose or delay packets, by `benchmarks/hosts.py --losses`."""
    measured = json.loads(LINKS.read_text(encoding="utf-8"))
    calm_s = min(run["travel_time_s"] for run in measured.values())
    lines = [
        (
            "| endpoint | packets lost per link, delay | pace | tick p50 / p99 | leader changes "
            "| in their lane | overlaps | travel time |"
        ),
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| `{run['link'].partition('?')[0]}/...{''.join(run['link'].partition('?')[1:])}` "
        f"| {'0 %' if run['text'] == 'nothing' else run['text']} | {run['real_time_factor']:.3f} "
        f"| {run['tick_ms_p50']:.0f} / {run['tick_ms_p99']:.0f} ms | {run['leader_changes']} "
        f"| {run['on_lane_percent']:.1f} % of {run['demanded']} | {run['overlaps']} "
        f"| {run['travel_time_s'] / calm_s:.3f}x |"
        for run in measured.values()
    ]
    return "\n".join(lines)


def _long_runs() -> str:
    """Return the table of the memory of long runs, by `benchmarks/long_run.py`."""
    lines = [
        (
            "| run | road | vehicles that passed | vehicle ticks | process "
            "| memory after 10 min, at the end | growth | file descriptors | threads |"
        ),
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, run in json.loads(LONG.read_text(encoding="utf-8")).items():
        about = (
            f"| {name}, {run['volume_veh_per_lane_h']:g} vehicles/(lane h) | {run['road_s']:,} s "
            f"| {run['left']:,} | {run['vehicle_ticks'] / 1e6:.2f} million "
        )
        for role, found in run["roles"].items():
            memory, handles, threads = (
                ", ".join(f"{value:g}" for value in found[figure])
                for figure in ("memory_mb", "handles", "threads")
            )
            growth = f"{found['growth_percent']:+.1f} %"
            lines.append(f"{about}| {role} | {memory} MB | {growth} | {handles} | {threads} |")
            about = "| | | | "
    return "\n".join(lines)


def _service() -> str:
    """Return the tables of the planning service, by `benchmarks/service.py`."""
    measured = json.loads(SERVICE.read_text(encoding="utf-8"))
    return "\n\n".join(
        "\n".join(table)
        for table in (
            _service_load(measured["load"]),
            _service_added(measured["half"]),
            _service_turns(measured["turns"]),
            _service_loss(measured["loss"]),
            _service_cancel(measured["cancel"]),
            _service_flood(measured["flood"], measured["road"]),
        )
    )


def _service_load(runs: list[dict[str, Any]]) -> Iterator[str]:
    yield "| 200 requests in flight | answered | with two plans | rate | solver's | solving |"
    yield "|---|---|---|---|---|---|"
    for run in runs:
        yield (
            f"| {run['clients']} clients, {_workers(run)} | {run['answered']} "
            f"| {run['answered_differently']} | {run['rate_per_s']:.2f} per s "
            f"| {run['of_solvers_rate']:.2f}x | {100 * run['of_workers_time']:.1f} % |"
        )


def _stability() -> str:
    """Return the table of how a speed disturbance propagates, by `benchmarks/stability.py`."""
    headings = (
        "", "speed lost, messages lost", "disturbed", "1st behind", "2nd behind", "last",
        "amplification", "any behind", "the last", "braked", "back after", "min. gap",
    )  # fmt: skip
    lines = [f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
    for row in json.loads(STABILITY.read_text(encoding="utf-8"))["rows"]:
        of = f"of {row['runs']}"
        cells = " | ".join(
            " / ".join(f"{row[name][number]:.2f}" for name in ("speed_mps", "gap_m", "accel_mps2"))
            for number in (0, 1, 2, -1)
        )
        ratios = [ratio for ratio in row["amplification"] if ratio is not None]
        low_high = f"{min(ratios):.2f} to {max(ratios):.2f}" if ratios else "-"
        lines.append(
            f"| {row['formation']} | {row['drop_mps']:g} m/s, {100 * row['loss']:g} % | {cells} "
            f"| {low_high} | {row['travelled']} {of} | {row['reached_last']} {of} "
            f"| {row['braked']} | {row['back_s']:.1f} s | {row['least_gap_m']:.2f} m |"
        )
    return "\n".join(lines)


def _surprises() -> str:
    """Return the table of runs with surprises, by `benchmarks/surprises.py`."""
    headings = (
        "surprise", "veh/(lane h)", "method", "runs", "mean delay", "range", "stopped in a run",
        "in another lane", "overlaps", "acceleration", "flows freely again after",
    )  # fmt: skip
    lines = [f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
    for point, runs in _measured(surprises.POINTS, SURPRISES):
        delays_s = [run["delay_s"] for run in runs]
        free_s = [run["free_again_s"] for run in runs]
        free = "no" if None in free_s else f"{max(free_s):.0f} s"
        if point.surprise == "none" or point.label in surprises.REFERENCES:
            free = ""
        lossy = f", {100 * point.loss:g} % loss" if point.loss else ""
        others = sum(run["in_another_lane"] for run in runs)
        lines.append(
            f"| {point.surprise}{lossy} | {point.volume} | {point.label} | {len(runs)} "
            f"| {fmean(delays_s):z.1f} s | {min(delays_s):z.1f} to {max(delays_s):z.1f} s "
            f"| {fmean(run['stopped'] for run in runs):.1f} "
            f"| {others} of {sum(run['left'] for run in runs):,} "
            f"| {sum(run['overlaps'] for run in runs)} "
            f"| {min(run['min_accel_mps2'] for run in runs):.1f} m/s2 "
            f"| {free} |"
        )
    return "\n".join(lines)


def _sensitivity() -> str:
    """Return the table of a study of single settings, by `laneweave sensitivity`."""
    study = json.loads(SENSITIVITY.read_text(encoding="utf-8"))
    levels = [("base", study["base"] | {"text": ""})]
    levels += [(one["name"], level) for one in study["factors"] for level in one["levels"]]
    rows = [
        result_row(
            name,
            one["text"],
            Result(**{key: one[key] for key in fields_dict(Result) if key in one}),
        )
        for name, one in levels
    ]
    lines = [markdown(HEADINGS, rows)]
    refused = [f"- {reason}" for one in study["factors"] for reason in one["refused"]]
    if refused:
        lines += ["", "Impossible on this road:", "", *refused]
    return "\n".join(lines)


def _service_added(runs: list[dict[str, Any]]) -> Iterator[str]:
    yield "| at half load | requests | solving p50 / p99 | added p50 / p95 / p99 |"
    yield "|---|---|---|---|"
    for run in runs:
        solve, added = run["solve_ms"], run["added_ms"]
        yield (
            f"| {run['sizes'][0]} to {run['sizes'][1]} vehicles, {_workers(run)} "
            f"| {run['requests']} | {solve['p50']:.1f} / {solve['p99']:.1f} ms "
            f"| {added['p50']:.1f} / {added['p95']:.1f} / {added['p99']:.1f} ms |"
        )


def _service_turns(runs: list[dict[str, Any]]) -> Iterator[str]:
    yield "| small requests one after the other | rate | beyond solving p50 / p99 | added p50 |"
    yield "|---|---|---|---|"
    for run in runs:
        beyond, added = run["beyond_solving_ms"], run["added_ms"]
        clients = f"{run['clients']} client{'s' if run['clients'] > 1 else ''}"
        yield (
            f"| {clients}, 2 workers | {run['rate_per_s']:.0f} per s "
            f"| {beyond['p50']:.1f} / {beyond['p99']:.1f} ms | {added['p50']:.1f} ms |"
        )


def _service_loss(loss: dict[str, Any]) -> Iterator[str]:
    beyond = loss["beyond_solving_ms"]
    yield "| one of three killed | requests | answered | hit | beyond solving p50 / p99 / max |"
    yield "|---|---|---|---|---|"
    yield (
        f"| {loss['killed']} times, {loss['rate_per_s']:.0f} requests per s | {loss['requests']} "
        f"| {loss['answered']} | {loss['around_the_kills']} "
        f"| {beyond['p50']:.0f} / {beyond['p99']:.0f} / {beyond['max']:.0f} ms |"
    )


def _service_cancel(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield "| client leaves a plan of 5 s | times | answer to the next request p50 / max |"
    yield "|---|---|---|"
    for row in rows:
        next_ms = row["next_ms"]
        yield (
            f"| {row['client']} | {row['times']} | {next_ms['p50']:.0f} / {next_ms['max']:.0f} ms |"
        )


def _service_flood(quiet: list[dict[str, Any]], roads: list[dict[str, Any]]) -> Iterator[str]:
    yield (
        "| 1000 requests in flight from another client, which | latency p50 / p99 "
        "| a run: real-time factor | tick p50 / p99 | leader changes |"
    )
    yield "|---|---|---|---|---|"
    for row, road in zip(quiet, roads, strict=True):
        quiet_ms, tick_ms = row["quiet_ms"], road["tick_ms"]
        yield (
            f"| {row['flood']} | {quiet_ms['p50']:.0f} / {quiet_ms['p99']:.0f} ms "
            f"| {road['real_time_factor']:.2f} | {tick_ms['p50']:.0f} / {tick_ms['p99']:.0f} ms "
            f"| {road['leader_changes']} |"
        )


def _workers(run: dict[str, Any]) -> str:
    return "1 worker" if run["workers"] == 1 else f"{run['workers']} workers"


@cache
def parts() -> dict[str, str]:
    """Return the generated parts by name."""
    return {
        "topics": _topics(),
        "messages": _messages(),
        "settings": _settings(),
        "findings": _findings(),
        "events": _events(),
        "api": api_reference(laneweave),
        "api of planners": api_reference(planners),
        "api of methods": api_reference(methods),
        "commands": command_reference(),
        "decisions": _decisions(),
        "scenario fields": _scenario_fields(),
        "vehicle rules": _rule_table(VEHICLE_RULES),
        "vehicle phases": _phase_diagram(VEHICLE_RULES, ExecutionPhase.FREE),
        "leader rules": _rule_table(LEADER_RULES),
        "leader phases": _phase_diagram(LEADER_RULES, BallotPhase.OBSERVING),
        "transfer rules": _rule_table(TRANSFER_RULES),
        "transfer phases": _phase_diagram(TRANSFER_RULES, BallotPhase.PREPARING),
        "planted bugs": _planted_bugs(),
        "unseen bugs": _unseen_bugs(),
        "road bugs": _road_bugs(),
        "caught bugs": _caught_bugs(),
        "found bugs": _found_bugs(),
        "profiles": _profiles(),
        "resilience": _resilience(),
        "planner": _planner(),
        "planner switches": _switches(),
        "conflict counts": _conflicts(),
        "conflict distances": _distances(),
        "geometry": _geometry(),
        "closing": _closing(),
        "service": _service(),
        "stability": _stability(),
        "sensitivity": _sensitivity(),
        "surprises": _surprises(),
        "radio": radio.table(DOCS / "evidence" / radio.RECORD),
        "stream": _stream(),
        "roads": _road_results(faults=False),
        "roads under faults": _road_results(faults=True),
        "roads over Zenoh": _road_processes(),
        "roads with reference methods": _road_references(),
        "metrics": _metrics(),
        "trajectories": _columns(TRAJECTORIES),
        "trips": _columns(TRIPS),
        "ticks": _columns(TICKS),
        "summary": _summary_fields(),
        "results": _columns(RESULTS),
        "event fields": _event_fields(),
        "rights": rights_table(),
        "hosts": _hosts(),
        "links": _links(),
        "long runs": _long_runs(),
        **document_parts(read_evidence(EVALUATED)),
    }


def rewritten(text: str) -> str:
    """Return a document's text with up-to-date generated parts."""
    known = parts()

    def replace(match: re.Match[str]) -> str:
        name = match[1]
        return f"<!-- begin {name} -->\n{known[name]}\n<!-- end {name} -->"

    return re.sub(r"<!-- begin ([\w ]+) -->\n.*?<!-- end \1 -->", replace, text, flags=re.DOTALL)


if __name__ == "__main__":
    for path in sorted(DOCS.glob("*.md")):
        path.write_text(rewritten(path.read_text(encoding="utf-8")), encoding="utf-8")
    draw_conflicts(CONFLICTS)
    draw_explanation(explain(PlanRequest.from_dict(json.loads(CASE.read_text("utf-8")))), SOLVING)
