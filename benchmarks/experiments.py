"""Experiments whose results are kept in a file, for hosts.py and resilience.py."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any


def run_missing(
    runs: Mapping[str, Callable[[Path], dict[str, Any]]], only: Sequence[str] | None, record: Path
) -> list[dict[str, Any]]:
    """Run the experiments without a result, or the requested ones; return their results.

    Args:
        runs: functions that run the experiments in a folder, by name of the experiment.
        only: names of the requested experiments; None: those without a result.
        record: JSON file of all results; the folders are beside this file.
    """
    record.parent.mkdir(parents=True, exist_ok=True)
    known = json.loads(record.read_text(encoding="utf-8")) if record.exists() else {}
    chosen = [name for name in runs if (name in only if only else name not in known)]
    for name in chosen:
        folder = record.parent.resolve() / re.sub(r"[^\w-]+", "-", name)
        shutil.rmtree(folder, ignore_errors=True)
        known[name] = runs[name](folder)
        others = {name: known[name] for name in known if name not in runs}
        ordered = {name: known[name] for name in runs if name in known} | others
        record.write_text(json.dumps(ordered, indent=1) + "\n", encoding="utf-8")
        print(name, json.dumps(known[name]), flush=True)  # noqa: T201
    return [known[name] for name in chosen]
