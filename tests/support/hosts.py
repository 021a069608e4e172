"""The deployment of compose.yaml as processes on hosts of their own, where there are no containers.

Hosts are network namespaces with addresses of their own, one each for vehicles, coordinators and
the simulation, and the hub, which runs the router and has a link to each of the others. Services
run with the commands, the configuration and the health checks of compose.yaml; only paths differ,
and where the other services are is written in a hosts file instead of an engine's name server.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from attrs import define, field

from laneweave.launch.faults.network_namespaces import (
    HUB,
    HUB_ADDRESS,
    PERFECT,
    GroupNetwork,
    Link,
    NamespacesUnavailableError,
)
from laneweave.launch.run.roles import fork_server
from laneweave.protocol.field_validators import is_encrypted
from support.commands import LANEWEAVE
from support.waiting import wait_until

ROOT = Path(__file__).resolve().parents[2]
CERTIFICATES = "/certs"
"""Where containers have them."""
PROGRAMS = {"laneweave": LANEWEAVE, "python": sys.executable}
LINKS = ("vehicles", "coordinators", "simulation")
"""Hosts beside the hub, each at the end of a link."""
END_S = 90.0
"""How long a process that was told to end may take, and a health check."""
READY_S = 90.0
"""How long services may take to be healthy; numba's code may have to be compiled."""
APART = "vehicles-2"
"""Host of the second agents process, if that is to have a link of its own."""
_HOST_OF = {
    "certs": HUB,
    "router": HUB,
    "coordinator": "coordinators",
    "agents": "vehicles",
    "bridge": "simulation",
    "watch": "simulation",
}
_ENTER = 'mount --bind "$0" /etc/hosts && exec "$@"'
"""In a mount namespace of its own, a process has a hosts file of its own."""


def compose() -> dict[str, Any]:
    """Return compose.yaml."""
    found: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))
    return found


def lasts(service: Mapping[str, Any]) -> bool:
    """Tell whether a service of compose.yaml goes on until it is told to end."""
    return service.get("restart") != "no"


@define
class Hosts:
    """Hosts with services on them; see `open_hosts`."""

    folder: Path
    """Of configuration, logs and runs."""
    network: GroupNetwork
    services: Mapping[str, Mapping[str, Any]]
    pace: float
    environment: Mapping[str, str]
    apart: bool = False
    """Whether the second agents process has a host of its own."""
    running: dict[str, subprocess.Popen[bytes]] = field(factory=dict)

    # --- services -----------------------------------------------------------------------------

    def start(self, *names: str) -> None:
        """Start services by their commands, the first time or again."""
        for name in names:
            words = self.services[name]["command"]
            if name == "bridge":
                words = [*words, "--pace", f"{self.pace:g}"]
            with (self.folder / f"{name}.log").open("ab") as log:
                self.running[name] = subprocess.Popen(
                    self._words(name, [LANEWEAVE, *words]),
                    cwd=self.folder,
                    env=dict(self.environment),
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )

    def start_all(self, loss: Link = PERFECT) -> None:
        """Start everything, the router after those who need it, the bridge when all is well.

        Args:
            loss: of all links from the bridge's start on.
        """
        names = [name for name, service in self.services.items() if lasts(service)]
        self.start(*(name for name in names if name not in ("router", "bridge")))
        self.start("router")
        self.wait_healthy(*self.services["bridge"]["depends_on"])
        self.network.set_links(dict.fromkeys(self.network.groups, loss))
        self.start("bridge")

    def healthy(self, name: str) -> bool:
        """Run a service's health check."""
        kind, program, *words = self.services[name]["healthcheck"]["test"]
        assert kind == "CMD"
        done = subprocess.run(
            self._words(name, [PROGRAMS[program], *words]),
            cwd=self.folder,
            env=dict(self.environment),
            capture_output=True,
            timeout=END_S,
            check=False,
        )
        return done.returncode == 0

    def wait_healthy(self, *names: str) -> None:
        """Wait until services are healthy."""

        def wait(name: str) -> None:
            wait_until(lambda: self.healthy(name), READY_S)

        # At the same time: most of a check is the start of an interpreter.
        with ThreadPoolExecutor() as pool:
            list(pool.map(wait, names))

    def kill(self, *names: str) -> None:
        """Kill services with SIGKILL, all at once."""
        for name in names:
            self.running[name].kill()
        for name in names:
            self.running.pop(name).wait(END_S)

    def stop(self, *names: str) -> dict[str, int]:
        """Ask services to end and return their exit statuses."""
        for name in names:
            self.running[name].terminate()
        return {name: self.running.pop(name).wait(END_S) for name in names}

    def finish(self, name: str, within_s: float) -> int:
        """Wait until a service ends by itself and return its exit status."""
        status = self.running[name].wait(within_s)
        del self.running[name]
        return status

    def _words(self, service: str, words: Iterable[str]) -> list[str]:
        host = (
            APART if self.apart and service == "agents-2" else _HOST_OF[service.partition("-")[0]]
        )
        namespace = f"/proc/{self.network.process_id(host)}/ns/net"
        enter = ["nsenter", f"--net={namespace}", "--", "unshare", "--mount", "--"]
        inside = (self._path(word) for word in words)
        return [*enter, "sh", "-c", _ENTER, str(self.folder / "hosts"), *inside]

    def _path(self, word: str) -> str:
        name = {"/scenarios/compose.toml": "deployment.toml", CERTIFICATES: "certs"}.get(word)
        return word if name is None else str(self.folder / name)

    # --- links --------------------------------------------------------------------------------

    def partition(self, host: str, for_s: float) -> None:
        """Cut a host off for some time."""
        self.network.set_links({host: Link(up=False)})
        time.sleep(for_s)
        self.network.set_links({})

    # --- the run ------------------------------------------------------------------------------

    @property
    def runs(self) -> list[Path]:
        """Folders of the runs, oldest first."""
        return sorted((self.folder / "runs").glob("*"), key=lambda path: path.stat().st_ctime)

    @property
    def road_s(self) -> float:
        """Road time of the newest run, of its last event."""
        for folder in reversed(self.runs):
            path = folder / "events.jsonl"
            lines = path.read_text(encoding="utf-8").rpartition("\n")[0] if path.exists() else ""
            if lines:
                return float(json.loads(lines.rpartition("\n")[2])["t_s"])
        return 0.0

    def wait_road(self, t_s: float, within_s: float = 120.0) -> None:
        """Wait for a road time."""
        wait_until(lambda: self.road_s >= t_s, within_s)


@contextmanager
def open_hosts(
    folder: Path,
    *,
    pace: float,
    link: str = "tls",
    apart: bool = False,
    delayed: bool = False,
    environment: Mapping[str, str] | None = None,
    **tables: Mapping[str, object],
) -> Iterator[Hosts]:
    """Make the hosts, and end whatever runs on them at last.

    Args:
        folder: a new one.
        pace: road seconds per second.
        link: protocol and options of endpoints, such as `quic?mixed_rel=1`; without encryption
            (`tcp`, `udp`) anybody may do anything.
        apart: whether the second agents process has a host of its own.
        delayed: whether links can delay packets.
        environment: of the services; none: this process's.
        **tables: entries of scenarios/compose.toml that are to be different, by table.

    Raises:
        NamespacesUnavailableError: there can be no hosts here; the message says why.
    """
    for program in ("nsenter", "unshare", "mount"):
        if shutil.which(program) is None:
            raise NamespacesUnavailableError(f"there is no program `{program}`")
    text = _configuration(_network(folder, link) | tables)
    (folder / "deployment.toml").write_text(text, encoding="utf-8")
    (folder / "hosts").write_text(f"127.0.0.1 localhost\n{HUB_ADDRESS} router\n", encoding="utf-8")
    names = (*LINKS, APART) if apart else LINKS
    network = GroupNetwork(fork_server(), names, delayed=names if delayed else ())
    network.open()
    services = compose()["services"]
    hosts = Hosts(folder, network, services, pace, environment or os.environ, apart)
    try:
        once = [name for name, service in services.items() if not lasts(service)]
        for name in once if is_encrypted(link) else []:
            hosts.start(name)
            if hosts.finish(name, END_S) != 0:
                raise RuntimeError((folder / f"{name}.log").read_text(encoding="utf-8"))
        yield hosts
    finally:
        for process in hosts.running.values():
            process.kill()
            process.wait(END_S)
        network.close()


def _network(folder: Path, link: str) -> dict[str, Mapping[str, object]]:
    protocol, question_mark, options = link.partition("?")
    end = f":7447{question_mark}{options}"
    security = {"folder": str(folder / "certs")} if is_encrypted(link) else {"mode": "off"}
    addresses = {"endpoint": f"{protocol}/router{end}", "listen": [f"{protocol}/0.0.0.0{end}"]}
    return {"security": security, "network": addresses}


def _configuration(changes: Mapping[str, Mapping[str, object]]) -> str:
    """Return scenarios/compose.toml with some entries changed."""
    path = ROOT / "scenarios" / "compose.toml"
    tables = tomllib.loads(path.read_text(encoding="utf-8"))
    for name, entries in changes.items():
        tables[name] = tables.get(name, {}) | dict(entries)
    top = {key: value for key, value in tables.items() if not isinstance(value, dict)}
    lines = [f"{key} = {json.dumps(value)}" for key, value in top.items()]
    for name, table in tables.items():
        if isinstance(table, dict):
            lines += [f"[{name}]", *(f"{key} = {_value(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _value(value: object) -> str:
    """Return a value as TOML has it."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(one)}" for key, one in value.items()) + " }"
    return json.dumps(value)
