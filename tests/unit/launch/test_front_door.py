"""`import laneweave`: public names, what they load, and their types in a user's program."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest

import laneweave
from support.commands import python, run
from support.tables import for_each

ROOT = Path(__file__).resolve().parents[3]
FRONT_DOOR = ROOT / "launch" / "laneweave" / "__init__.py"
PATH = [entry for entry in sys.path if entry]


def imports_for_type_checkers() -> dict[str, str]:
    """Return the module of each name that the front door imports for type checkers."""
    tree = ast.parse(FRONT_DOOR.read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    return {
        name.name: str(node.module)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }


def test_type_checkers_and_python_see_the_same_names() -> None:
    assert imports_for_type_checkers() == laneweave._MODULES
    assert set(laneweave.__all__) == {*laneweave._MODULES, "__version__"}
    assert list(laneweave.__all__) == sorted(laneweave.__all__)


@for_each("name", laneweave.__all__)
def test_public_names_exist(name: str) -> None:
    assert getattr(laneweave, name)
    assert name in dir(laneweave)


def test_unknown_names_are_no_attributes() -> None:
    with pytest.raises(AttributeError, match="module 'laneweave' has no attribute 'runs'"):
        _ = laneweave.runs


def test_the_import_loads_nothing() -> None:
    program = f"""
import sys; sys.path[:0] = {PATH!r}
import laneweave
print(*(name for name in sys.modules if name.split(".")[0] in ("attrs", "numpy", "laneweave")))
"""
    done = python(program)
    assert (done.returncode, done.stdout.split()) == (0, ["laneweave"]), done.stderr


@pytest.mark.slow
@pytest.mark.more
def test_a_wheel_is_typed_for_users(tmp_path: Path) -> None:
    """Build and install the wheel, and check a user's program elsewhere."""
    pip, site = (sys.executable, "-m", "pip"), tmp_path / "site"
    options = ("--no-deps", "--no-build-isolation", "--no-index", "-q")
    done = run(*pip, "install", *options, "--target", site, ROOT)
    assert done.returncode == 0, done.stderr
    inits = [path.parent.name for path in site.glob("laneweave/**/__init__.py")]
    assert inits.count("laneweave") == 1
    program = tmp_path / "program.py"
    program.write_text(
        "import laneweave\n"
        "reveal_type(laneweave.run(seed=3))\n"
        "reveal_type(laneweave.plan({}).cost)\n"
        "reveal_type(laneweave.load_run('x').events('plan-made'))\n"
        "laneweave.run(method=7)\n",
        encoding="utf-8",
    )
    environment = {"MYPYPATH": str(site), "PATH": "", "HOME": str(tmp_path)}
    checks = ("--strict", "--follow-imports=silent", "--ignore-missing-imports")
    done = run(sys.executable, "-m", "mypy", *checks, program, cwd=tmp_path, env=environment)
    types = re.findall(r'Revealed type is "(.*)"', done.stdout)
    assert types == [
        "laneweave.protocol.summary.RunSummary",
        "int | None",
        "list[dict[str, Any]]",
    ], done.stdout
    (error,) = (line for line in done.stdout.splitlines() if ": error:" in line)
    assert 'incompatible type "int"; expected "str"' in error
    done = run(
        sys.executable, "-c", "import laneweave; print(laneweave.plan.__module__)",
        cwd=tmp_path, env=environment | {"PYTHONPATH": str(site)},
    )  # fmt: skip
    assert done.stdout == "laneweave.launch.library.plans\n", done.stderr
