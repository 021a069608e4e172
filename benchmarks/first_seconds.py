"""Time of the first commands of a user: `python benchmarks/first_seconds.py [--json] [--runs N]`.

For each command, the medians of some runs: wall time, and CPU time of the command's process.

    help            `laneweave --help`
    plan            `laneweave plan` for the paper's case study
    first_plan      the same if no solver is compiled
    first_service   from the start of a coordinator to the answer of `laneweave plan --connect`, if
                    no solver is compiled; a router runs already

The wall time also depends on other load. The CPU time of `first_service` is that of the client.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

LANEWEAVE = str(Path(sys.executable).with_name("laneweave"))
CASE = Path(__file__).resolve().parents[1] / "docs" / "examples" / "case-study.json"
WAIT_S = 60
RUNS = 5


def command(*words: object, cache: Path | None = None) -> None:
    """Run `laneweave` to its end, with another cache of numba if one is given."""
    environment = os.environ | ({} if cache is None else {"NUMBA_CACHE_DIR": str(cache)})
    line = [LANEWEAVE, *map(str, words)]
    subprocess.run(line, check=True, stdout=subprocess.DEVNULL, env=environment)  # noqa: S603


@contextlib.contextmanager
def role(*words: str, cache: Path) -> Iterator[None]:
    """Run a role until the context exits."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    line, quiet = [LANEWEAVE, *words], subprocess.DEVNULL
    with subprocess.Popen(line, env=environment, stderr=quiet) as process:  # noqa: S603
        try:
            yield
        finally:
            process.terminate()


def timed(run: Callable[[], None]) -> tuple[float, float]:
    """Return the wall time and the CPU time of finished child processes [s]."""
    before, began_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    run()
    wall_s = time.perf_counter() - began_s
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def plan_cold() -> tuple[float, float]:
    """Measure a plan with an empty cache."""
    with tempfile.TemporaryDirectory(prefix="laneweave-bench-") as folder:
        return timed(lambda: command("plan", CASE, cache=Path(folder)))


def service_cold() -> tuple[float, float]:
    """Measure the first answer of a new coordinator with an empty cache."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()
    endpoint = f"tcp/{address[0]}:{address[1]}"
    with tempfile.TemporaryDirectory(prefix="laneweave-bench-") as folder:
        cache = Path(folder)
        with role("router", "--endpoint", endpoint, cache=cache):
            _await_server(address)
            with contextlib.ExitStack() as stack:

                def answer() -> None:
                    stack.enter_context(
                        role("coordinator", "--endpoint", endpoint, "--log", "json", cache=cache)
                    )
                    command("plan", CASE, "--connect", endpoint, "--wait", WAIT_S)

                return timed(answer)


def _await_server(address: tuple[str, int]) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while time.monotonic() < deadline_s:
        with contextlib.suppress(OSError), socket.create_connection(address):
            return
        time.sleep(0.05)
    raise RuntimeError("the router does not start")


MEASUREMENTS: dict[str, Callable[[], tuple[float, float]]] = {
    "help": lambda: timed(lambda: command("--help")),
    "plan": lambda: timed(lambda: command("plan", CASE)),
    "first_plan": plan_cold,
    "first_service": service_cold,
}


def main() -> None:
    """Measure and print the figures."""
    parser = argparse.ArgumentParser(description="Time of the first commands of a user.")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--runs", type=int, default=RUNS, help="runs of each command")
    options = parser.parse_args()
    found = {}
    for name, measure in MEASUREMENTS.items():
        walls, cpus = zip(*(measure() for _ in range(options.runs)), strict=True)
        found[name] = {
            "wall_s": round(statistics.median(walls), 3),
            "cpu_s": round(statistics.median(cpus), 3),
        }
    if options.json:
        sys.stdout.write(json.dumps(found) + "\n")
        return
    for name, figures in found.items():
        sys.stdout.write(f"{name:15}{figures['wall_s']:8.3f} s{figures['cpu_s']:8.3f} s CPU\n")


if __name__ == "__main__":
    main()
