"""The documents agree with the code: tables, links, commands, examples."""

from __future__ import annotations

import importlib.util
import inspect
import json
import re
import shlex
import tomllib
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, get_args, get_type_hints

import attrs
import numpy as np
import pytest
import typer
from numpy.typing import NDArray

from laneweave.agents.driving.trajectory import move_profile
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.launch.cli.main import command_line
from laneweave.launch.cli.plan_answers import answer_request
from laneweave.launch.faults.fault_file import (
    GROUPS,
    Kill,
    LinkFault,
    Partition,
    Pause,
    load_faults,
    preset_names,
)
from laneweave.launch.observe.status import SCHEMA, Status
from laneweave.protocol.config.scenario_files import load_scenario, parse_scenario
from laneweave.protocol.lattice import Cell, footprint
from laneweave.protocol.runtime.message_faults import MessageRule
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.structuring import key_in_files
from laneweave.protocol.summary import Ending
from laneweave.protocol.vehicle.motion import cell_state
from laneweave.protocol.wire.codec import KINDS
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Bodies, pose_of
from scenario_reference import (
    MISSING,
    default_of,
    limits_of,
    meanings_in,
    range_of,
    scenario_fields,
    scenario_table,
)
from support.tables import for_each

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
COORDINATORS = tuple(f"c{number}" for number in range(1, 10))
NOT_OURS = {"runs", "build", "dist", "node_modules"}

FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ +(.+)$", re.MULTILINE)


def project_files(pattern: str) -> list[Path]:
    """Return the files below the project's own folders."""
    found: list[Path] = []
    for folder in ROOT.iterdir():
        if folder.is_dir() and folder.name[0] != "." and folder.name not in NOT_OURS:
            found += folder.rglob(pattern)
    return found


MARKDOWN = sorted([*ROOT.glob("*.md"), *project_files("*.md")])
each_document = for_each("path", MARKDOWN)


def read(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def fences(text: str, *languages: str) -> list[str]:
    return [body for language, body in FENCE.findall(text) if language in languages]


def section(text: str, heading: str) -> str:
    """Return the text below a heading, up to the next heading of the same or a higher level."""
    level = len(heading) - len(heading.lstrip("#"))
    begin = re.search(rf"^{re.escape(heading)}$", text, re.MULTILINE)
    assert begin is not None, f"no heading {heading!r}"
    rest = text[begin.end() :]
    end = re.search(rf"^#{{1,{level}}} ", rest, re.MULTILINE)
    return rest[: end.start()] if end else rest


def rows(text: str) -> list[list[str]]:
    """Return the body rows of the first table in a text."""
    lines: list[str] = []
    for line in text.splitlines():
        if line.startswith("|"):
            lines.append(line)
        elif lines:
            break
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines[2:]]


def code(text: str) -> str:
    return text.strip("`")


# --- docs/SCENARIO.md: every field of a scenario -------------------------------------------------


def test_scenario_fields_have_a_meaning() -> None:
    assert meanings_in(scenario_table({})) == {name: MISSING for name, _ in scenario_fields()}
    meanings = meanings_in(section(read("SCENARIO.md"), "## All fields"))
    missing = [name for name, _ in scenario_fields() if meanings[name] in ("", MISSING)]
    assert not missing, f"fields without a meaning: {missing}"


def test_rules_between_fields_name_existing_fields() -> None:
    part = section(read("SCENARIO.md"), "## Rules between fields")
    known = {name for name, _ in scenario_fields()}
    named = set(re.findall(r"`([a-z]+\.[a-z_0-9]+)`", part))
    assert named
    assert named <= known


# --- docs/FAULTS.md and docs/RUNS.md -------------------------------------------------------------


@pytest.mark.parametrize(
    ("heading", "kind"),
    [
        ("## Messages: `[[messages]]`", MessageRule),
        ("## Kills: `[[kill]]`", Kill),
        ("## Pauses: `[[pause]]`", Pause),
        ("## Partitions: `[[partition]]`", Partition),
        ("## Lost and delayed packets: `[[link]]`", LinkFault),
    ],
)
def test_tables_of_faults(heading: str, kind: type) -> None:
    shown = {code(cells[0]): cells[1:] for cells in rows(section(read("FAULTS.md"), heading))}
    fields = {key_in_files(field): field for field in attrs.fields(kind)}
    assert shown.keys() == fields.keys()
    for name, (default, allowed, meaning) in shown.items():
        limits = limits_of(fields[name])
        assert default == default_of(fields[name]), name
        assert "low" not in limits or allowed == range_of(limits), name
        assert meaning, name


def test_presets_and_groups_of_faults() -> None:
    presets = rows(section(read("FAULTS.md"), "## Presets"))
    assert tuple(sorted(code(cells[0]) for cells in presets)) == preset_names()
    for heading in ("## Partitions: `[[partition]]`", "## Lost and delayed packets: `[[link]]`"):
        part = section(read("FAULTS.md"), heading)
        assert all(f"`{group}`" in part for group in GROUPS), heading


def test_endings_of_runs() -> None:
    (meaning,) = (
        cells[1]
        for cells in rows(section(read("RUNS.md"), "## The end of a run"))
        if code(cells[0]) == "ending"
    )
    assert set(re.findall(r"`(\w+)`:", meaning)) == {ending.value for ending in Ending}


# --- docs/PROTOCOL.md: keys and messages ---------------------------------------------------------


def test_docstrings_of_messages_state_what_loss_delay_and_duplication_cause() -> None:
    for kind in KINDS.values():
        text = inspect.getdoc(kind) or ""
        assert "Missing" in text, kind.__name__
        assert re.search("[Ll]ate|[Oo]lder", text), kind.__name__
        assert re.search("[Dd]uplicated", text), kind.__name__


def test_generated_parts_are_up_to_date() -> None:
    """Generated parts equal the output of `python docs/generate.py`."""
    specification = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    assert specification is not None
    assert specification.loader is not None
    generate = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(generate)
    found = 0
    for path in DOCS.glob("*.md"):
        text = path.read_text(encoding="utf-8")
        found += text.count("<!-- begin ")
        assert generate.rewritten(text) == text, path.name
    assert found == len(generate.parts())


def test_places_in_the_code_exist() -> None:
    """Documents name `module.py: Class.method`, `module.py: function` or `folder/module.py`."""
    sources = {
        path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
        for path in project_files("*.py")
    }
    documents = "".join(path.read_text(encoding="utf-8") for path in DOCS.glob("*.md"))
    places = re.findall(r"`((?:\w+/)*\w+\.py)(?:: ([\w.]+))?`", documents)
    assert places
    for module, name in places:
        text = "".join(text for path, text in sources.items() if f"/{path}".endswith(f"/{module}"))
        assert text, f"there is no {module}"
        last = name.rpartition(".")[2]
        assert re.search(rf"\b(def|class) {last}\b|^{last}\b", text, re.MULTILINE) or not name, (
            f"{module} has no {name}"
        )


# --- docs/SAFETY.md: the minimum gap -------------------------------------------------------------


def test_minimum_gap_of_mode_1() -> None:
    """Vehicles with disjoint footprints, one up to 2 s late, on the trajectories in use."""
    min_m = min(_gaps_of_pairs(Scenario(), late_ticks=(0, 10, 20)))
    assert f"**{min_m:.2f} m**" in read("SAFETY.md")


def _gaps_of_pairs(scenario: Scenario, late_ticks: Sequence[int]) -> Iterator[float]:
    body = scenario.vehicle.length_m, scenario.vehicle.width_m
    steps = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    origin = (0, 0)
    around = [(c, lane) for c in (-2, -1, 0, 1, 2) for lane in (-1, 0, 1) if (c, lane) != origin]
    for a, b, cell, late in product(steps, steps, around, late_ticks):
        if footprint(origin, a) & footprint(cell, (cell[0] + b[0], cell[1] + b[1])):
            continue
        first, second = _motion(scenario, origin, a, 0), _motion(scenario, cell, b, late)
        near = np.abs(first[:, 3] - second[:, 3]) < 3.0  # no turned body is wider
        for one, other in zip(first[near][::2], second[near][::2], strict=True):
            if abs(one[0] - other[0]) < 16.0:
                yield Bodies({"a": pose_of(one), "b": pose_of(other)}, *body).min_gaps().gap_m


@lru_cache(maxsize=1024)
def _motion(scenario: Scenario, cell: Cell, step: Cell, late: int) -> NDArray[np.float64]:
    """Return states (60, 6) of a move that begins `late` ticks late, relative to the lattice."""
    states = move_profile(scenario, scenario.vehicle, *step).states
    at = np.clip(np.arange(60) - late, 0, len(states) - 1)
    moved: NDArray[np.float64] = states[at] + np.array(cell_state(scenario.lattice, cell, 0.0))
    return moved


# --- docs/DEPLOYMENT.md ---------------------------------------------------------------------------


def _fields_of(kind: type, prefix: str = "") -> Iterator[str]:
    hints = get_type_hints(kind)
    for attribute in attrs.fields(kind):
        parts = [hints[attribute.name], *get_args(hints[attribute.name])]
        inner = next((part for part in parts if isinstance(part, type) and attrs.has(part)), None)
        if inner is None or attribute.name in ("candidates", "findings", "road"):
            yield f"{prefix}{attribute.name}"
        if inner is not None:
            yield from _fields_of(inner, f"{prefix}{attribute.name}.")


def test_fields_of_a_status() -> None:
    text = section(read("DEPLOYMENT.md"), "### Status").partition("`--json` prints")[2]
    shown = [code(cells[0]) for cells in rows(text)]
    assert shown == ["schema", *_fields_of(Status)]
    assert f"`{SCHEMA}`" in text


def test_all_metrics_are_documented() -> None:
    """Every snapshot class (class variable `ABOUT`) has rows in the table of metrics."""
    shown = [code(cells[0]) for cells in rows(section(read("DEPLOYMENT.md"), "### Metrics"))]
    subjects = [
        subject
        for path in ROOT.glob("*/laneweave/**/*.py")
        for subject in re.findall(r'ABOUT: ClassVar\[str\] = "(\w+)"', path.read_text("utf-8"))
    ]
    assert len(subjects) >= 6
    for subject in subjects:
        assert any(name.startswith(f"laneweave_{subject}_") for name in shown), subject


def test_log_options_are_as_documented() -> None:
    program: Any = typer.main.get_command(command_line())
    for option, variable, *_ in rows(section(read("DEPLOYMENT.md"), "### Logs")):
        for role in ("router", "coordinator", "agent", "bridge"):
            (found,) = (
                parameter
                for parameter in program.commands[role].params
                if code(option) in parameter.opts
            )
            assert found.envvar == code(variable)


# --- everywhere ----------------------------------------------------------------------------------


def anchors(text: str) -> set[str]:
    """Return the anchors of a document's headings, as GitHub makes them."""
    found: set[str] = set()
    for heading in HEADING.findall(FENCE.sub("", text)):
        plain = re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")
        number = 0
        while (anchor := plain if number == 0 else f"{plain}-{number}") in found:
            number += 1
        found.add(anchor)
    return found


@each_document
def test_links_resolve(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    broken = []
    for link in LINK.findall(FENCE.sub("", text)):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (path.parent / name).resolve() if name else path
        if not target.exists() or (anchor and anchor not in anchors(target.read_text("utf-8"))):
            broken.append(link)
    assert not broken


def commands(text: str) -> Iterator[str]:
    """Yield the `laneweave` command lines of a document."""
    for body in fences(text, "", "sh", "bash", "console"):
        for entry in body.replace("\\\n", " ").splitlines():
            command = entry.strip().removeprefix("$ ")
            if command.startswith("laneweave "):
                yield command
    yield from re.findall(r"`(laneweave [^`\n]+)`", FENCE.sub("", text))


def test_all_options_are_in_the_reference() -> None:
    program: Any = typer.main.get_command(command_line())
    sections = {"laneweave": program}
    while sections:
        name, command = sections.popitem()
        for inner, found in getattr(command, "commands", {}).items():
            sections[f"{name} {inner}"] = found
        if hasattr(command, "commands"):
            continue
        level = "#" * len(name.split())
        part = section(read("COMMANDS.md"), f"{level} {name}")
        options = [one.opts[0] for one in command.params if one.param_type_name == "option"]
        assert [option for option in options if f"`{option}" not in part] == [], name


@each_document
def test_commands_exist(path: Path) -> None:
    program = typer.main.get_command(command_line())
    subcommands: dict[str, Any] = getattr(program, "commands", {})
    without_command = {"--help", *(name for one in program.params for name in one.opts)}
    for command in commands(path.read_text(encoding="utf-8")):
        words = shlex.split(command, comments=True)[1:]
        if not words or words[0].isupper() or words[0] in without_command:
            continue
        assert words[0] in subcommands, command
        subcommand = subcommands[words[0]]
        if words[1:] and words[1] in getattr(subcommand, "commands", {}):
            subcommand = subcommand.commands[words[1]]
            del words[0]
        known = {one for given in subcommand.params for one in (*given.opts, *given.secondary_opts)}
        options = {word.partition("=")[0] for word in words if word.startswith("--")}
        assert options <= known | {"--help"}, command
        if len(words) > 1 and not re.search(r"[\[\]|>&]|\.\.\.|--help", command):
            # A complete command: the parser accepts it, with placeholders as file names.
            subcommand.make_context(words[0], words[1:])


@each_document
def test_toml_in_documents_loads(path: Path, tmp_path: Path) -> None:
    for body in fences(path.read_text(encoding="utf-8"), "toml"):
        data = tomllib.loads(body)
        if not data.keys().isdisjoint({"messages", "kill", "pause", "partition", "link"}):
            file = tmp_path / "faults.toml"
            file.write_text(body)
            load_faults(file, COORDINATORS)
        else:
            parse_scenario(data)


@each_document
def test_scenario_files_that_documents_name_exist(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    for name in re.findall(r"(?<![\w/])scenarios/[\w./-]+\.toml", text):
        assert (ROOT / name).is_file(), name


@for_each("path", sorted([*(ROOT / "scenarios").rglob("*.toml"), *DOCS.rglob("*.toml")]))
def test_scenario_files_load(path: Path) -> None:
    if path.parent.name == "faults":
        assert load_faults(path, COORDINATORS)
    else:
        load_scenario(path)


def test_requests_in_documents_and_examples_are_valid() -> None:
    texts = [body for path in MARKDOWN for body in fences(path.read_text("utf-8"), "json")]
    requests = [data for data in map(json.loads, texts) if "plan.request" in data.get("schema", "")]
    requests += [json.loads(path.read_text("utf-8")) for path in (DOCS / "examples").glob("*.json")]
    assert len(requests) > 2
    for request in requests:
        PlanRequest.from_dict(request)


def test_answer_to_the_case_study_is_as_shown(capsys: pytest.CaptureFixture[str]) -> None:
    answer_request(DOCS / "examples/case-study.json", None, None, "tappa", as_table=True)
    assert capsys.readouterr().out in fences(read("PLANNING.md"), "text")


def test_decisions_are_listed_and_have_three_parts() -> None:
    decisions = sorted((DOCS / "adr").glob("[0-9]*.md"))
    numbers = [int(path.name[:4]) for path in decisions]
    assert numbers == list(range(1, len(numbers) + 1))
    for path in decisions:
        headings = HEADING.findall(path.read_text(encoding="utf-8"))
        assert headings[1:] == ["Context", "Decision", "Consequences"], path.name
        assert f"](adr/{path.name})" in read("DECISIONS.md"), f"{path.name} is not listed"
