"""Structured logs: JSON lines in the run's folder, or readable lines on a terminal."""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path

import structlog


def log_to_terminal() -> None:
    """Write warnings and errors to stderr, one readable line each."""
    structlog.configure(
        processors=[
            structlog.processors.TimeStamper(fmt="%H:%M:%S"),
            structlog.processors.add_log_level,
            structlog.processors.format_exc_info,
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty()),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING),
        # Whatever stderr is by then.
        logger_factory=lambda *_: structlog.PrintLogger(sys.stderr),
        cache_logger_on_first_use=False,
    )


def last_error(path: Path, name: str) -> str:
    """Return the last error that a process of a run logged, as one line; empty: none."""
    found = ""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    for line in lines:
        try:
            entry = json.loads(line)
        except ValueError:  # cut off when its process was killed
            continue
        if entry.get("level") == "error" and entry.get("name") == name:
            text = entry.get("reason") or entry.get("exception") or entry.get("event") or ""
            found = str(text).strip().rpartition("\n")[2]
    return found


def log_to_file(path: Path, role: str, name: str) -> None:
    """Append JSON lines to a file that all processes of a run share."""
    # Unbuffered appends of whole lines do not mix, whoever writes them.
    stream = path.open("a", buffering=1, encoding="utf-8")
    structlog.contextvars.bind_contextvars(role=role, name=name)
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.TimeStamper(fmt="iso"),
            structlog.processors.add_log_level,
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        logger_factory=structlog.WriteLoggerFactory(stream),
        cache_logger_on_first_use=True,
    )
