"""A deployment whose roles a test starts one by one."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
from pathlib import Path
from typing import Any

from support.harness import END_S, ROAD, RUN_S, Ended, Lab

REALM = "test"


def free_port() -> int:
    """Return a port that was free a moment ago."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
        return port


def free_tcp() -> str:
    """Return an endpoint on a port that was free a moment ago."""
    return f"tcp/127.0.0.1:{free_port()}"


def deployment(lab: Lab, endpoint: str, more: str = "") -> Path:
    """Write a deployment's configuration; `more` continues its table `network`."""
    text = f"""{ROAD}
[demand]
volume_veh_per_lane_h = 1300.0
duration_s = 14.0

[network]
realm = "{REALM}"
endpoint = "{endpoint}"
{more}"""
    return lab.path("deployment.toml", text)


def ping(lab: Lab, config: Path) -> Ended:
    """Run `laneweave ping`."""
    return lab.run_forked("ping", "--config", config, alone=False)


def start_router(lab: Lab, config: Path, **environment: str) -> subprocess.Popen[str]:
    """Start a router and wait until clients can connect."""
    router = lab.start("router", "--config", config, **environment)
    lab.wait_until(lambda: ping(lab, config).status == 0, END_S)
    return router


def ask(lab: Lab, config: Path, request: dict[str, Any], *options: str) -> Ended:
    """Run `laneweave plan` with the planning service of a deployment."""
    path = lab.path("request.json", json.dumps(request))
    return lab.run_forked("plan", path, "--config", config, *options, within_s=RUN_S, alone=False)


def stop(lab: Lab, *processes: subprocess.Popen[str]) -> None:
    """End processes with SIGTERM; they must end in order and without errors."""
    for process in processes:
        process.send_signal(signal.SIGTERM)
    for process in processes:
        ended = lab.finish(process, END_S)
        assert (ended.status, ended.out, ended.complaints) == (0, "", []), ended
