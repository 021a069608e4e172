"""Rules of the repository that no other tool checks: package, pinned versions, base install."""

from __future__ import annotations

import os
import re
import tomllib
from functools import cache
from pathlib import Path

import grimp
import pytest

import laneweave
from laneweave.launch.cli.commands import COMMANDS
from support.commands import LANEWEAVE, python, run
from support.extras import normal, only_extras, only_for
from support.variants import variants

ROOT = Path(__file__).resolve().parents[2]
ROOTS = ("agents", "coordinator", "protocol", "sim_bridge", "launch")


def test_only_launch_has_the_front_door() -> None:
    # A second __init__.py would hide the first one, depending on the order of `sys.path`.
    found = [root for root in ROOTS if (ROOT / root / "laneweave" / "__init__.py").exists()]
    assert found == ["launch"]
    assert (ROOT / "launch" / "laneweave" / "py.typed").exists()


@pytest.mark.parametrize("root", ROOTS)
def test_packages_are_typed(root: str) -> None:
    assert (ROOT / root / "laneweave" / root / "__init__.py").exists()
    assert (ROOT / root / "laneweave" / root / "py.typed").exists()


@cache
def import_graph() -> grimp.ImportGraph:
    """Return the imports of all modules; grimp finds the five folders of an imported package."""
    return grimp.build_graph(laneweave.__name__, cache_dir=None)


@pytest.mark.parametrize("root", ROOTS)
def test_imports_have_at_most_eight_levels_in_a_package_and_five_in_a_folder(root: str) -> None:
    graph = import_graph()
    inside = graph.find_descendants(f"laneweave.{root}") | {f"laneweave.{root}"}

    def levels(modules: frozenset[str]) -> int:
        @cache
        def level(module: str) -> int:
            imported = graph.find_modules_directly_imported_by(module) & modules
            return 1 + max(map(level, imported), default=0)

        return max(map(level, modules))

    assert levels(frozenset(inside)) <= 8
    for folder in inside:
        assert levels(frozenset({folder, *graph.find_children(folder)})) <= 5, folder


def test_modules_have_at_most_500_lines() -> None:
    lines = {
        path.relative_to(ROOT).as_posix(): len(path.read_text(encoding="utf-8").splitlines())
        for root in ROOTS
        for path in (ROOT / root).rglob("*.py")
    }
    assert {name: count for name, count in lines.items() if count > 500} == {}


def test_every_dependency_is_pinned_by_name_and_version_only() -> None:
    pinned = set()
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][A-Za-z0-9.]*", line), line
        pinned.add(normal(line.partition("==")[0]))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"].values()
    wanted = [*project["dependencies"], *(one for extra in extras for one in extra)]
    assert {normal(re.split(r"[\[<>=]", one)[0]) for one in wanted} - {"laneweave"} <= pinned


CASE_STUDY = "docs/examples/case-study.json"
ROUTER = "router --endpoint tcp/127.0.0.1:1"


REFUSED_IN_TURN = """
import contextlib, io, sys
from laneweave.launch.cli.main import _status
for command in sys.argv[1:]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = _status(command.split())
    print(status, repr(out.getvalue()), err.getvalue(), end="")
"""
"""Runs commands in one process, since starting one takes longer; prints a line for each."""


@pytest.mark.slow
@pytest.mark.more
def test_packages_of_other_extras_are_hidden() -> None:
    # As the bridge did that drew its report with modules of the agents.
    environment = os.environ | only_for("bridge")
    done = python("import matplotlib, osqp", cwd=ROOT, env=environment)
    assert "No module named 'osqp'" in done.stderr
    done = python("import osqp", cwd=ROOT, env=os.environ | only_for("agent"))
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extras", "command", "says"),
    variants(
        [
            ("plan", f"plan {CASE_STUDY} --format table", "cost 7"),
            ("", "config check scenarios/compose.toml", "tls/router:7447"),
            ("certs", "certs init {folder}/certs --separate", "coordinator.c3"),
            # Nothing is at the endpoint: these commands fail last, with all that they import.
            ("", "ping --endpoint tcp/127.0.0.1:1", "tcp/127.0.0.1:1"),
            ("", "status --endpoint tcp/127.0.0.1:1", "tcp/127.0.0.1:1"),
            ("watch", "watch --endpoint tcp/127.0.0.1:1 --listen 127.0.0.1:0", "tcp/127.0.0.1:1"),
        ]
    ),
)
def test_commands_need_only_their_extra(
    extras: str, command: str, says: str, tmp_path: Path
) -> None:
    # `test_roles_by_hand` runs all other roles like this.
    environment = os.environ | only_extras(*extras.split())
    words = command.format(folder=tmp_path).split()
    done = run(LANEWEAVE, *words, cwd=ROOT, env=environment)
    assert "not installed" not in done.stderr
    assert says in done.stdout + done.stderr


MISSING: dict[str, list[tuple[str, str, str]]] = {
    "": [
        ("run --duration 5", "", "not installed"),
        (f"plan {CASE_STUDY} --solver branching", "", "[plan]"),
        ("coordinator --endpoint tcp/127.0.0.1:1", "", "[plan]"),
        ("agent --endpoint tcp/127.0.0.1:1", "", "[agent]"),
        ("bridge --endpoint tcp/127.0.0.1:1", "", "[sim]"),
        (f"{ROUTER} --metrics 127.0.0.1:1", "prometheus_client: not installed", "[metrics]"),
        ("certs init new-folder", "", "laneweave[certs]"),
        ("watch --endpoint tcp/127.0.0.1:1", "", "laneweave[watch]"),
    ],
    "plan": [
        (f"plan {CASE_STUDY} --draw plan.png", "", "not installed"),
        (f"plan {CASE_STUDY} --draw-road road.png", "--draw-road: got 'road.png'",
         "laneweave[agent] and laneweave[sim]"),
    ],
}  # fmt: skip
"""By installed extra: commands, and how the line begins with which they are refused, and a part."""


@pytest.mark.slow
@pytest.mark.parametrize("extra", MISSING)
def test_commands_name_the_missing_extra(extra: str) -> None:
    commands = [command for command, _, _ in MISSING[extra]]
    environment = os.environ | only_extras(*extra.split())
    done = python(REFUSED_IN_TURN, *commands, cwd=ROOT, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    for line, (_, begins, names) in zip(done.stdout.splitlines(), MISSING[extra], strict=True):
        assert line.startswith(f"2 '' {begins}")
        assert names in line
    assert not (ROOT / "new-folder").exists()


@pytest.mark.slow
def test_the_live_page_needs_no_packages_for_recordings() -> None:
    others = "pyarrow libsumo matplotlib psutil jinja2 osqp"
    missing = f"import sys; sys.modules |= dict.fromkeys({others.split()})"
    done = python(f"{missing}; import laneweave.launch.watch.process", cwd=ROOT)
    assert (done.returncode, done.stderr) == (0, "")


def test_makefile_and_containerfile_run_commands_that_exist() -> None:
    texts = [(ROOT / file).read_text(encoding="utf-8") for file in ("Makefile", "Containerfile")]
    commands = set(re.findall(r"(?:RUN |\$\(BIN\)/)laneweave (\w+)", "".join(texts)))
    assert {"compile", "run"} <= commands <= COMMANDS.keys()
