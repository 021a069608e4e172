"""`import laneweave`: public names, what they load, and their types in a user's program."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

import laneweave
from support.commands import python

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


@pytest.mark.parametrize("name", laneweave.__all__)
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
