"""Structured logs, as text or as JSON lines for the folder of a run or a log collector."""

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
    """Format of a role's log on stderr."""

    text = "text"
    json = "json"


class LogLevel(StrEnum):
    """Lowest level that is logged."""

    debug = "debug"
    info = "info"
    warning = "warning"
    error = "error"


def log_role(role: str, name: str, form: LogFormat, level: LogLevel | None) -> None:
    """Write the log of a role to stderr; default level: `info` for JSON, `warning` for text."""
    if form is LogFormat.text:
        log_to_terminal(level or LogLevel.warning)
        return
    _log_json(lambda *_: _stderr_logger(), role, name, level or LogLevel.info)
    log = structlog.get_logger(__name__)

    def on_failure(kind: type[BaseException], error: BaseException | None, trace: Any) -> None:  # noqa: ANN401 (a traceback)
        log.error("role failed", exc_info=(kind, error, trace))

    # Log uncaught exceptions as one line, too, because collectors do not join lines.
    sys.excepthook = on_failure
    threading.excepthook = lambda args: on_failure(
        args.exc_type, args.exc_value, args.exc_traceback
    )


def log_by_default() -> None:
    """Write warnings and errors to stderr, unless the program has configured structlog itself."""
    if not structlog.is_configured():
        log_to_terminal()


def log_to_terminal(level: LogLevel = LogLevel.warning) -> None:
    """Write log entries of at least `level` to stderr, one readable line each."""
    structlog.configure(
        processors=[
            structlog.processors.TimeStamper(fmt="%H:%M:%S"),
            structlog.processors.add_log_level,
            structlog.processors.format_exc_info,
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty()),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(_number(level)),
        # Look up stderr for each entry, because it may be replaced.
        logger_factory=lambda *_: _stderr_logger(),
        cache_logger_on_first_use=False,
    )


def last_error(path: Path, name: str) -> str:
    """Return the last error logged by a process of a run, as one line; empty if there is none."""
    found = ""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    for line in lines:
        try:
            entry = json.loads(line)
        except ValueError:  # truncated when the process was killed
            continue
        if entry.get("level") == "error" and entry.get("name") == name:
            text = entry.get("reason") or entry.get("exception") or entry.get("event") or ""
            found = str(text).strip().rpartition("\n")[2]
    return found


def log_to_file(path: Path, role: str, name: str) -> None:
    """Log JSON lines to a file that all processes of a run share."""
    # Lines of different processes do not interleave, because each line is one write.
    stream = path.open("a", buffering=1, encoding="utf-8")
    _log_json(lambda *_: structlog.WriteLogger(_lossy(stream)), role, name, LogLevel.info)


class _LossyStream(io.TextIOBase):
    """Stream that ignores write errors, so that a full disk does not stop a role."""

    def __init__(self, stream: TextIO) -> None:
        """Write to `stream`."""
        self._stream = stream

    def write(self, text: str) -> int:
        """Write text; ignore errors."""
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush; ignore errors."""
        with contextlib.suppress(OSError, ValueError):
            self._stream.flush()


def _lossy(stream: TextIO) -> TextIO:
    return cast("TextIO", _LossyStream(stream))


def _stderr_logger() -> structlog.PrintLogger:
    return structlog.PrintLogger(_lossy(sys.stderr))


def _log_json(make_logger: Callable[..., Any], role: str, name: str, level: LogLevel) -> None:
    structlog.configure(
        processors=[
            _with_origin(role, name),
            structlog.processors.TimeStamper(fmt="iso"),
            structlog.processors.add_log_level,
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(_number(level)),
        logger_factory=make_logger,
        cache_logger_on_first_use=True,
    )


def _with_origin(role: str, name: str) -> Processor:
    """Return a processor that adds role and name to log entries of all threads."""

    def add(_logger: object, _method: str, entry: EventDict) -> EventDict:
        entry.setdefault("role", role)
        entry.setdefault("name", name)
        return entry

    return add


def _number(level: LogLevel) -> int:
    return logging.getLevelNamesMapping()[level.value.upper()]
