"""Structured logs: JSON lines in the run's folder or for a collector, or readable lines."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import sys
import threading
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Any, TextIO, cast

import structlog
from structlog.typing import EventDict, Processor


class LogFormat(StrEnum):
    """How a role writes its log to stderr."""

    text = "text"
    json = "json"


class LogLevel(StrEnum):
    """The least important entries that a role writes."""

    debug = "debug"
    info = "info"
    warning = "warning"
    error = "error"


def log_role(role: str, name: str, form: LogFormat, level: LogLevel | None) -> None:
    """Write a role's log to stderr; without a `level` from `info` on as JSON, else `warning`."""
    if form is LogFormat.text:
        log_to_terminal(level or LogLevel.warning)
        return
    _log_json(lambda *_: _stderr_logger(), role, name, level or LogLevel.info)
    log = structlog.get_logger(__name__)

    def on_failure(kind: type[BaseException], error: BaseException | None, trace: Any) -> None:  # noqa: ANN401 (a traceback)
        log.error("role failed", exc_info=(kind, error, trace))

    # What nobody catches is a line like all others; a collector takes no lines together.
    sys.excepthook = on_failure
    threading.excepthook = lambda args: on_failure(
        args.exc_type, args.exc_value, args.exc_traceback
    )


def log_to_terminal(level: LogLevel = LogLevel.warning) -> None:
    """Write warnings and errors to stderr, one readable line each; or from `level` on."""
    structlog.configure(
        processors=[
            structlog.processors.TimeStamper(fmt="%H:%M:%S"),
            structlog.processors.add_log_level,
            structlog.processors.format_exc_info,
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty()),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(_number(level)),
        # Whatever stderr is by then.
        logger_factory=lambda *_: _stderr_logger(),
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
    _log_json(lambda *_: structlog.WriteLogger(_patient(stream)), role, name, LogLevel.info)


class _Patient(io.TextIOBase):
    """A stream that loses what cannot be written.

    A full disk, or a collector that has gone, must not end a role that has something to say.
    """

    def __init__(self, stream: TextIO) -> None:
        """Write to `stream`."""
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, or lose it."""
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush, or lose it."""
        with contextlib.suppress(OSError, ValueError):
            self._stream.flush()


def _patient(stream: TextIO) -> TextIO:
    return cast("TextIO", _Patient(stream))


def _stderr_logger() -> structlog.PrintLogger:
    return structlog.PrintLogger(_patient(sys.stderr))


def _log_json(make_logger: Callable[..., Any], role: str, name: str, level: LogLevel) -> None:
    structlog.configure(
        processors=[
            _signed(role, name),
            structlog.processors.TimeStamper(fmt="iso"),
            structlog.processors.add_log_level,
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(_number(level)),
        logger_factory=make_logger,
        cache_logger_on_first_use=True,
    )


def _signed(role: str, name: str) -> Processor:
    """Return what puts role and name into every entry, whichever thread writes it."""

    def sign(_logger: object, _method: str, entry: EventDict) -> EventDict:
        entry.setdefault("role", role)
        entry.setdefault("name", name)
        return entry

    return sign


def _number(level: LogLevel) -> int:
    return logging.getLevelNamesMapping()[level.value.upper()]
