"""Values of options that several commands share."""

from __future__ import annotations

import os
import re

from laneweave.protocol.errors import BadInputError

MOST_SEEDS = 10_000_000
MOST_JOBS = 256


def parse_seeds(text: str, most: int = MOST_SEEDS) -> range:
    """Return the seeds of `A:B`, B excluded.

    Raises:
        BadInputError: it is no such range, an empty one or too long.
    """
    match = re.fullmatch(r"(\d{1,12}):(\d{1,12})", text)
    seeds = range(int(match[1]), int(match[2])) if match else range(0)
    if not 0 < len(seeds) <= most:
        raise BadInputError("--seeds", text, f"A:B with A < B, at most {most} seeds")
    return seeds


def check_jobs(jobs: int | None) -> int:
    """Return the number of processes to use; None: as many as there are cores.

    Raises:
        BadInputError: it is out of range.
    """
    if jobs is None:
        return len(os.sched_getaffinity(0))
    if not 1 <= jobs <= MOST_JOBS:
        raise BadInputError("--jobs", jobs, f"[1, {MOST_JOBS}]")
    return jobs
