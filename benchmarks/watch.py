"""Measure the live page at 90 vehicles: `python benchmarks/watch.py [--json FILE] [--picture PNG]`.

Starts a deployment on this machine: router, three coordinators, two agent processes, bridge in real
time, `laneweave watch`, and Debian's Chromium. When 90 vehicles are on the road, the page is opened
and observed for some seconds, several times:

    first_paint_ms     first contentful paint, as the browser measures it
    first_frame_ms     first drawn frame of the road
    ticks_per_s        ticks of the road, the upper bound of the next two rates
    updates_per_s      received frames
    drawn_per_s        drawn frames
    server_cpu_share   CPU time of `laneweave watch`, as a share of one core
"""

from __future__ import annotations

import argparse
import contextlib
import json
import platform
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
from attrs import define, field
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

LANEWEAVE = str(Path(sys.executable).with_name("laneweave"))
ROUNDS = 5
OBSERVED_S = 5.0
TICK_S = 0.1
START_S = 30.0
FILL_S = 240.0
FIRST_PAINT = "return performance.getEntriesByName('first-contentful-paint')[0].startTime"
STATS = "return {...laneweaveWatch.stats, t: laneweaveWatch.store.newest?.t}"
DEPLOYMENT = """\
schema = "laneweave.scenario/1"
[demand]
volume_veh_per_lane_h = {volume}
duration_s = 600.0
[network]
realm = "demo"
endpoint = "unixsock-stream/router.sock"
"""


@define
class Deployment:
    """The processes of a deployment, in a separate folder."""

    folder: Path
    _processes: list[subprocess.Popen[str]] = field(factory=list)

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start a role."""
        process = subprocess.Popen(  # noqa: S603
            [LANEWEAVE, *arguments, "--config", "deployment.toml"],
            cwd=self.folder,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._processes.append(process)
        return process

    def end(self) -> None:
        """Stop all roles, in the reverse order of their start."""
        for process in reversed(self._processes):
            process.send_signal(signal.SIGTERM)
        for process in self._processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=START_S)
            process.kill()

    def answers(self) -> bool:
        """Return whether the router answers."""
        ping = [LANEWEAVE, "ping", "--config", "deployment.toml"]
        done = subprocess.run(ping, cwd=self.folder, capture_output=True, check=False)  # noqa: S603
        return done.returncode == 0


def wait_until(condition: Callable[[], bool], within_s: float) -> None:
    """Wait until a condition holds.

    Raises:
        TimeoutError: it did not hold in time.
    """
    deadline = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"the condition did not hold within {within_s:g} s")
        time.sleep(0.1)


@contextlib.contextmanager
def chromium() -> Iterator[webdriver.Chrome]:
    """Yield a browser."""
    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.add_argument("--window-size=1400,1050")
    options.add_argument("--hide-scrollbars")
    driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
    try:
        yield driver
    finally:
        driver.quit()


def measure(driver: webdriver.Chrome, address: str, server: psutil.Process) -> dict[str, float]:
    """Open the page and observe it for some seconds."""
    driver.get("about:blank")
    driver.get(address)
    wait_until(lambda: driver.execute_script(STATS)["shown"] > 2, START_S)
    cpu, began, before = server.cpu_times(), time.monotonic(), driver.execute_script(STATS)
    time.sleep(OBSERVED_S)
    after, took_s = driver.execute_script(STATS), time.monotonic() - began
    spent = server.cpu_times()
    vehicles = int(driver.execute_script("return document.getElementById('count').textContent"))
    return {
        "vehicles": vehicles,
        "first_paint_ms": round(float(driver.execute_script(FIRST_PAINT)), 1),
        "first_frame_ms": round(float(after["firstFrameMs"]), 1),
        "ticks_per_s": round((after["t"] - before["t"]) / TICK_S / took_s, 2),
        "updates_per_s": round((after["frames"] - before["frames"]) / took_s, 2),
        "drawn_per_s": round((after["shown"] - before["shown"]) / took_s, 2),
        "server_cpu_share": round((spent.user + spent.system - cpu.user - cpu.system) / took_s, 3),
    }


def run(vehicles: int, picture: Path | None) -> dict[str, Any]:
    """Fill a road, observe the page, and return the measurements."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lw-")))
        # A vehicle takes 67 s for the road's 1000 m; this volume gives the requested number.
        volume = 1.06 * vehicles * 3600.0 / (3 * 67.0)
        (folder / "deployment.toml").write_text(DEPLOYMENT.format(volume=round(volume, 1)))
        deployment = Deployment(folder)
        stack.callback(deployment.end)
        deployment.start("router")
        wait_until(deployment.answers, START_S)
        for name in ("c1", "c2", "c3"):
            deployment.start("coordinator", "--name", name)
        for shard in ("0/2", "1/2"):
            deployment.start("agent", "--shard", shard)
        watch = deployment.start("watch", "--listen", "127.0.0.1:0")
        assert watch.stdout is not None  # noqa: S101 (a pipe)
        address = watch.stdout.readline().strip()
        driver = stack.enter_context(chromium())
        driver.get(address)
        wait_until(lambda: _text(driver, "leader")[:1] == "c", START_S)
        deployment.start("bridge", "--pace", "1", "--out", "out")
        wait_until(lambda: _text(driver, "count").isdecimal(), START_S)
        wait_until(lambda: int(_text(driver, "count")) >= vehicles, FILL_S)
        process = psutil.Process(watch.pid)
        rounds = [measure(driver, address, process) for _ in range(ROUNDS)]
        if picture is not None:
            height = driver.execute_script("return document.body.scrollHeight")
            size = {"width": 1400, "height": height, "deviceScaleFactor": 1, "mobile": False}
            driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            # In the middle of a slot many vehicles are moving.
            wait_until(lambda: 1.7 < driver.execute_script(STATS)["t"] % 4.0 < 2.4, START_S)
            driver.save_screenshot(str(picture))
        return {
            "machine": {"cores": psutil.cpu_count(), "python": platform.python_version()},
            "browser": f"Chromium {driver.capabilities['browserVersion']}, headless",
            "load_average_1min": round(psutil.getloadavg()[0], 2),
            "rounds": rounds,
            "median": {name: statistics.median(one[name] for one in rounds) for name in rounds[0]},
        }


def _text(driver: webdriver.Chrome, identity: str) -> str:
    script = f"return document.getElementById('{identity}').textContent"
    return str(driver.execute_script(script))


def main() -> None:
    """Measure, print JSON, and write it to a file if requested."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, default=90)
    parser.add_argument("--json", type=Path, help="output file")
    parser.add_argument("--picture", type=Path, help="file for a screenshot")
    options = parser.parse_args()
    text = json.dumps(run(options.vehicles, options.picture), indent=2)
    if options.json is not None:
        options.json.write_text(text + "\n", encoding="utf-8")
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
