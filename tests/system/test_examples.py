"""The examples, as README tells to run them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.deployments import REALM, ask, deployment, free_tcp, start_router, stop
from support.harness import END_S, Ended, Lab
from support.service_lab import request

EXAMPLES = Path(__file__).parents[2] / "examples"
MAX_LINES = 40


@pytest.mark.parametrize("example", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_an_example_is_short(example: Path) -> None:
    assert len(example.read_text(encoding="utf-8").splitlines()) < MAX_LINES


def test_examples_ask_a_coordinator(lab: Lab) -> None:
    endpoint = free_tcp()
    config = deployment(lab, endpoint)
    text = config.read_text(encoding="utf-8")
    config.write_text(text.replace(f'"{REALM}"', '"default"'), encoding="utf-8")
    router = start_router(lab, config)
    coordinator = lab.start("coordinator", "--config", config)
    lab.wait_until(lambda: ask(lab, config, request()).status == 0, END_S)

    assert _run("ask_the_coordinator", endpoint).startswith("optimal: cost ")
    assert _run("only_zenoh_and_json", endpoint).startswith("optimal cost 7\n")

    stop(lab, coordinator, router)


def _run(example: str, endpoint: str) -> str:
    done = subprocess.run(
        [sys.executable, EXAMPLES / f"{example}.py", endpoint],
        capture_output=True,
        text=True,
        timeout=END_S,
        check=False,
        env=dict(os.environ) | {"PYTHONWARNINGS": "error"},
    )
    ended = Ended(done.returncode, done.stdout, done.stderr)
    assert (ended.status, ended.complaints) == (0, []), ended
    return ended.out


@pytest.mark.more
def test_a_plan_waits_for_router_and_coordinator(lab: Lab) -> None:
    endpoint = free_tcp()
    config = deployment(lab, endpoint)
    path = lab.path("request.json", json.dumps(request()))
    asked = lab.start("plan", path, "--connect", endpoint, "--realm", REALM, "--wait", f"{END_S:g}")
    router = start_router(lab, config)
    coordinator = lab.start("coordinator", "--config", config)

    ended = lab.finish(asked)

    assert (ended.status, ended.complaints) == (0, []), ended
    assert json.loads(ended.out)["status"] == "optimal"
    stop(lab, coordinator, router)
