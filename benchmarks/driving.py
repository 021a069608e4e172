"""Goals of the lower level, on random formations.

    python benchmarks/driving.py switches [--count 1000] [--seed 0] [--json]
    python benchmarks/driving.py emergencies [--count 2000] [--seed 0] [--json]

In closed loop without network and SUMO (`tests/support/driving.py`). `switches`: formation
switches on the timetable, half in each mode, against lattice points, limits and gaps.
`emergencies`: the vehicle ahead brakes to a stop while all messages stop; bodies must not touch.
`--json` prints JSON; `--first N --count 1` repeats one simulation. The exit status is 1 if a goal
is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

if __name__ == "__main__":  # run as a program: as `pythonpath` in pyproject.toml
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from support import emergencies, switches

T = TypeVar("T")


def simulated(simulate: Callable[[int], T], numbers: Sequence[int], jobs: int) -> list[T]:
    """Return the result of each number, in order; show the progress on a terminal."""
    results = []
    with ProcessPoolExecutor(jobs) as pool:
        for result in pool.map(simulate, numbers, chunksize=4):
            results.append(result)
            if sys.stderr.isatty():
                sys.stderr.write(f"\r{len(results)} of {len(numbers)} ")
                sys.stderr.flush()
    if sys.stderr.isatty():
        sys.stderr.write("\r\033[K")
    return results


def judge_switches(seed: int, numbers: Sequence[int], jobs: int) -> dict[str, Any]:
    """Return figures and missed goals of formation switches, by mode."""
    results = simulated(partial(switches.switch_result, seed), numbers, jobs)
    judged = {}
    for mode in (1, 2):
        chosen = [result for result in results if result.mode == mode]
        if chosen:
            figures = switches.summary(chosen)
            judged[f"mode {mode}"] = figures | {"missed": switches.missed_goals(figures)}
    return judged


def judge_emergencies(seed: int, numbers: Sequence[int], jobs: int) -> dict[str, Any]:
    """Return figures and missed goals of emergencies, by kind."""
    outcomes = simulated(partial(emergencies.outcome, seed), numbers, jobs)
    judged = {}
    for kind in emergencies.KINDS:
        chosen = [outcome for outcome in outcomes if outcome.kind == kind]
        if chosen:
            figures = emergencies.summary(chosen)
            judged[kind] = figures | {"missed": emergencies.missed_goals(figures)}
    return judged


COMMANDS = {"switches": (judge_switches, 1000), "emergencies": (judge_emergencies, 2000)}


def lines(figures: dict[str, Any], indent: str = "  ") -> list[str]:
    """Return figures as lines of text."""
    text = []
    for name, value in figures.items():
        if isinstance(value, dict):
            text += [f"{indent}{name}", *lines(value, indent + "  ")]
        elif isinstance(value, list):
            text += [f"{indent}{name}: {', '.join(map(str, value)) or 'none'}"]
        else:
            shown = f"{value:.6g}" if isinstance(value, float) else value
            text.append(f"{indent}{name}: {shown}")
    return text


def main() -> int:
    """Simulate, print, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("programme", choices=COMMANDS)
    parser.add_argument("--count", type=int, help="number of simulations; default: 1000 or 2000")
    parser.add_argument("--seed", type=int, default=0, help="seed of all random draws")
    parser.add_argument("--first", type=int, default=0, help="number of the first simulation")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="number of processes")
    parser.add_argument("--json", action="store_true", help="print JSON")
    chosen = parser.parse_args()
    judge, count = COMMANDS[chosen.programme]
    numbers = range(chosen.first, chosen.first + (chosen.count or count))
    judged = judge(chosen.seed, numbers, chosen.jobs)
    if chosen.json:
        sys.stdout.write(json.dumps(judged, indent=1) + "\n")
    else:
        for name, figures in judged.items():
            sys.stdout.write("\n".join([name, *lines(figures)]) + "\n")
    return int(any(figures["missed"] for figures in judged.values()))


if __name__ == "__main__":
    sys.exit(main())
