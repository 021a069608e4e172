"""Rules of the repository that no other tool checks: namespace, pinned versions, base install."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOTS = ("agents", "coordinator", "protocol", "sim_bridge", "launch")


def pinned() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").split()
    pairs = [line.split("==") for line in lines]
    return {_normal(name): version for name, version in pairs}


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.parametrize("root", ROOTS)
def test_namespace_has_no_init(root: str) -> None:
    # An __init__.py here would hide the other four portions of the namespace.
    assert not (ROOT / root / "laneweave" / "__init__.py").exists()
    assert (ROOT / root / "laneweave" / root / "__init__.py").exists()
    assert (ROOT / root / "laneweave" / root / "py.typed").exists()


def test_every_dependency_is_pinned_by_name_and_version_only() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = list(project["dependencies"])
    for extra in project["optional-dependencies"].values():
        wanted += extra
    names = {_normal(re.split(r"[\[<>=]", one)[0]) for one in wanted} - {"laneweave"}
    assert names - set(pinned()) == set()


def test_constraints_are_names_and_versions_only() -> None:
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][A-Za-z0-9.]*", line), line


BASE_INSTALL = """
import sys
extras = "osqp libsumo pyarrow matplotlib psutil distributed prometheus_client cryptography"
extras += " starlette uvicorn websockets"
for missing in extras.split():
    sys.modules[missing] = None
import laneweave.coordinator.process
from laneweave.launch.cli.main import main
sys.argv = ["laneweave", *sys.argv[1:]]
main()
"""


def run_base_install(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", BASE_INSTALL, *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=ROOT,
    )


def test_base_install_plans() -> None:
    done = run_base_install("plan", "docs/examples/case-study.json", "--format", "table")
    assert (done.returncode, done.stderr) == (0, "")
    assert "cost 7" in done.stdout


def test_base_install_names_the_extra_for_runs() -> None:
    done = run_base_install("run", "--duration", "5")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "not installed" in done.stderr


def test_base_install_names_the_extra_for_metrics() -> None:
    done = run_base_install("router", "--endpoint", "tcp/127.0.0.1:1", "--metrics", "127.0.0.1:1")
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("prometheus_client: not installed")
    assert line.endswith("install laneweave[metrics]")


def test_base_install_names_the_extra_for_drawings() -> None:
    done = run_base_install("plan", "docs/examples/case-study.json", "--draw", "plan.png")
    assert (done.returncode, done.stdout) == (2, "")
    assert "not installed" in done.stderr


def test_base_install_names_the_extras_for_drawings_of_the_road() -> None:
    done = run_base_install("plan", "docs/examples/case-study.json", "--draw-road", "road.png")
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("--draw-road: got 'road.png'")
    assert "laneweave[agent] and laneweave[sim]" in line


def test_base_install_names_the_extra_for_certificates(tmp_path: Path) -> None:
    done = run_base_install("certs", "init", str(tmp_path / "certs"))
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1
    assert "laneweave[certs]" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_base_install_checks_a_configuration() -> None:
    done = run_base_install("config", "check", "scenarios/compose.toml")
    assert done.returncode == 0
    assert "tls/router:7447" in done.stdout


def test_base_install_names_the_extra_for_the_live_page() -> None:
    done = run_base_install("watch", "--endpoint", "tcp/127.0.0.1:1")
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1
    assert "laneweave[watch]" in done.stderr


def test_makefile_and_containerfile_import_what_exists() -> None:
    imports = [
        (module, name)
        for file in ("Makefile", "Containerfile")
        for module, name in re.findall(
            r"from (laneweave[\w.]*) import (\w+)", (ROOT / file).read_text(encoding="utf-8")
        )
    ]
    assert imports
    for module, name in imports:
        assert hasattr(importlib.import_module(module), name), f"{module} has no {name}"
