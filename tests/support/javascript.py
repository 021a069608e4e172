"""Runs the scripts of pages in Node."""

from __future__ import annotations

import json
import shutil
from typing import Any

import pytest

from support.commands import run

NODE = shutil.which("node")
needs_node = pytest.mark.skipif(
    NODE is None, reason="node is not installed: nothing here can run the page's script"
)


def printed_json(program: str, data: object = None) -> Any:  # noqa: ANN401 - any JSON
    """Return the JSON that a program prints; it reads `data` as JSON from its standard input."""
    done = run(NODE, "-e", program, input=json.dumps(data))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
