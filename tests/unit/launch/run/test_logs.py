"""Logs of roles: JSON lines that say who wrote them, whichever thread it was."""

from __future__ import annotations

import json

import pytest

from support.commands import python

PROGRAM = """
import sys, threading, structlog
from laneweave.launch.run.logs import LogFormat, LogLevel, log_role
level = LogLevel(sys.argv[2]) if len(sys.argv) > 2 else None
log_role("coordinator", "c1", LogFormat(sys.argv[1]), level)
log = structlog.get_logger()
log.debug("detail")
log.info("begun", term=3)
def work():
    log.warning("from a thread")
    raise ValueError("in a thread")
thread = threading.Thread(target=work)
thread.start()
thread.join()
raise RuntimeError("not caught")
"""


def test_json_lines() -> None:
    done = python(PROGRAM, "json")
    assert (done.returncode, done.stdout) == (1, "")
    entries = [json.loads(line) for line in done.stderr.splitlines()]
    assert [(entry["event"], entry["level"]) for entry in entries] == [
        ("begun", "info"),
        ("from a thread", "warning"),
        ("role failed", "error"),
        ("role failed", "error"),
    ]
    assert all((entry["role"], entry["name"]) == ("coordinator", "c1") for entry in entries)
    assert all(entry["timestamp"].endswith("Z") for entry in entries)
    assert entries[0]["term"] == 3
    assert "ValueError: in a thread" in entries[2]["exception"]
    assert entries[3]["exception"].endswith("RuntimeError: not caught")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("json", "debug"), {"detail", "begun", "from a thread"}),
        (("json", "error"), set[str]()),
        (("text",), {"from a thread"}),
        (("text", "info"), {"begun", "from a thread"}),
    ],
)
def test_levels(arguments: tuple[str, ...], said: set[str]) -> None:
    err = python(PROGRAM, *arguments).stderr
    assert {one for one in ("detail", "begun", "from a thread") if one in err} == said


@pytest.mark.parametrize("form", ["text", "json"])
def test_a_log_that_cannot_be_written_does_not_end_the_process(form: str) -> None:
    program = """
import sys, structlog
from laneweave.launch.run.logs import LogFormat, log_role
log_role("coordinator", "c1", LogFormat(sys.argv[1]), None)
structlog.get_logger().warning("into a full disk")
print("goes on")
"""
    with open("/dev/full", "w", encoding="utf-8") as full:  # noqa: PTH123 (a device)
        done = python(program, form, stderr=full)
    assert done.stdout == "goes on\n"
