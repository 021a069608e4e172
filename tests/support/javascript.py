"""Runs the scripts of pages in Node."""

from __future__ import annotations

import json
import shutil
import subprocess
from typing import Any

import pytest

NODE = shutil.which("node")
needs_node = pytest.mark.skipif(
    NODE is None, reason="node is not installed: nothing here can run the page's script"
)


def printed_json(program: str, data: object = None) -> Any:  # noqa: ANN401 - any JSON
    """Return the JSON that a program prints; it reads `data` as JSON from its standard input."""
    done = subprocess.run(
        [str(NODE), "-e", program],
        input=json.dumps(data),
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
