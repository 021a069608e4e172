"""The deployment of compose.yaml in containers of a real engine, podman or docker.

Environment variables: `CONTAINER_BUILD_OPTIONS` has more options for the engine's `build`, and
`LANEWEAVE_BASE_IMAGE` names another base image, as for compose.yaml itself.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import subprocess
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from attrs import define, field, frozen

from support.hosts import ROOT, compose
from support.waiting import wait_until

COMMAND_S = 120.0
"""Longest time of a command that does not build or start images."""
UP_S = 400.0
BUILD_S = 1500.0
READY_S = 120.0
"""Longest time until a service is healthy."""
COMPOSE = {
    "podman": (["podman-compose"], ["podman", "compose"]),
    "docker": (["docker", "compose"], ["docker-compose"]),
}
"""Programs that read compose.yaml, by engine, in order of preference."""


class EngineUnavailableError(Exception):
    """There is no container engine; the message says what was tried."""


def find_engine() -> Engine:
    """Return the first engine that works here.

    Raises:
        EngineUnavailableError: there is none.
    """
    tried = []
    for program, readers in COMPOSE.items():
        if shutil.which(program) is None:
            tried.append(f"there is no program `{program}`")
        elif not _works([program, "info"]):
            tried.append(f"`{program} info` fails")
        else:
            for words in readers:
                if shutil.which(words[0]) and _works([*words, "version"]):
                    return Engine(program, words)
            tried.append(f"{program} has no `{' '.join(readers[0])}`")
    raise EngineUnavailableError("; ".join(tried))


def _works(words: list[str]) -> bool:
    try:
        return subprocess.run(words, capture_output=True, timeout=60.0, check=False).returncode == 0
    except subprocess.TimeoutExpired:
        return False


@frozen
class Engine:
    """A container engine and its program for compose files."""

    program: str
    compose: list[str]

    def __call__(self, *words: str, within_s: float = COMMAND_S, check: bool = True) -> str:
        """Run a command of the engine and return its output."""
        return _run([self.program, *words], within_s, check=check)

    def build(self, target: str, tag: str, arguments: dict[str, str]) -> None:
        """Build a target of Containerfile."""
        options = shlex.split(os.environ.get("CONTAINER_BUILD_OPTIONS", ""))
        for name, value in arguments.items():
            options += ["--build-arg", f"{name}={substituted(value)}"]
        build = ["build", "--file", "Containerfile", "--target", target, "--tag", tag]
        self(*build, *options, ".", within_s=BUILD_S)

    def size(self, image: str) -> int:
        """Return the size of an image in bytes."""
        return int(self("image", "inspect", "--format", "{{.Size}}", image))

    def layers(self, image: str) -> list[str]:
        """Return the digests of an image's layers, the lowest first."""
        found: list[str] = json.loads(
            self("image", "inspect", "--format", "{{json .RootFS.Layers}}", image)
        )
        return found


@define
class Containers:
    """The services of compose.yaml in containers; see `open_containers`."""

    engine: Engine
    services: dict[str, dict[str, Any]]
    project: str = field(factory=lambda: f"laneweave-test-{uuid.uuid4().hex[:8]}")

    def up(self, *services: str) -> None:
        """Start services and those that they depend on, or all; their images must exist."""
        self._compose("up", "--detach", "--no-build", *services, within_s=UP_S)

    def down(self) -> None:
        """Remove all containers and volumes, also those of a project that did not start fully."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._compose("down", "--volumes", within_s=UP_S, check=False)
        for name in self.left("ps", "--all"):
            self.engine("rm", "--force", name, check=False)
        for name in self.left("volume", "ls"):
            self.engine("volume", "rm", "--force", name, check=False)
        for name in self.left("network", "ls"):
            self.engine("network", "rm", name, check=False)

    def left(self, *listed: str) -> list[str]:
        """Return the names of what the engine lists (`ps`, `volume ls`, ...) of this project."""
        column = "{{.Names}}" if listed[0] == "ps" else "{{.Name}}"
        names = self.engine(*listed, "--format", column).split()
        return [name for name in names if name.startswith(self.project)]

    def container(self, service: str) -> str:
        """Return the name of a service's container."""
        for joint in "_-":
            name = f"{self.project}{joint}{service}{joint}1"
            if name in self.left("ps", "--all"):
                return name
        raise LookupError(service)

    def state(self, service: str) -> dict[str, Any]:
        """Return the engine's record of a service's container."""
        name = self.container(service)
        found: dict[str, Any] = json.loads(
            self.engine("inspect", "--type", "container", "--format", "{{json .State}}", name)
        )
        return found

    def execute(self, service: str, *words: str, check: bool = True) -> str:
        """Run a command in a service's container and return its output."""
        return self.engine("exec", self.container(service), *words, check=check)

    def healthy(self, service: str) -> bool:
        """Run a service's health check of compose.yaml in its container.

        The engine runs it, too, but not every engine has a timer for it.
        """
        kind, *words = self.services[service]["healthcheck"]["test"]
        assert kind == "CMD"
        done = _done([self.engine.program, "exec", self.container(service), *words], COMMAND_S)
        return done.returncode == 0

    def wait_healthy(self, *services: str) -> None:
        """Wait until services are healthy."""
        for service in services:
            wait_until(partial(self.healthy, service), READY_S, partial(str, service))

    @contextmanager
    def frozen(self, service: str) -> Iterator[None]:
        """Stop the processes of a service with SIGSTOP, and resume them at the end."""
        self.execute(service, "sh", "-c", "kill -STOP -1")
        try:
            yield
        finally:
            self.execute(service, "sh", "-c", "kill -CONT -1")

    def kill(self, service: str) -> None:
        """Kill a service's process with SIGKILL and wait until the engine has restarted it."""
        before = self.state(service)["StartedAt"]
        # The process kills all but itself and the container's init process, which then ends.
        self.execute(service, "sh", "-c", "kill -9 -1", check=False)
        wait_until(lambda: self._restarted(service, before), READY_S)

    def _restarted(self, service: str, before: str) -> bool:
        state = self.state(service)
        return bool(state["StartedAt"] != before and state["Status"] == "running")

    def wait_ended(self, service: str, within_s: float) -> int:
        """Wait until a service has ended by itself, and return its exit status."""
        wait_until(lambda: self.state(service)["Status"] == "exited", within_s)
        status: int = self.state(service)["ExitCode"]
        return status

    def in_volume(self, volume: str, *words: str) -> str:
        """Run a command in a folder with the content of a volume, and return its output."""
        (name,) = (one for one in self.left("volume", "ls") if one == f"{self.project}_{volume}")
        image = self.services["router"]["image"]
        entry = ["--entrypoint", words[0], "--workdir", "/volume"]
        return self.engine(
            "run", "--rm", "--volume", f"{name}:/volume:ro", *entry, image, *words[1:]
        )

    def files(self, volume: str) -> set[str]:
        """Return the files of a volume, as paths."""
        return set(self.in_volume(volume, "find", ".", "-type", "f").split())

    def logs(self) -> str:
        """Return the last lines of each service's log."""
        texts = []
        for service in self.services:
            try:
                done = _done(
                    [self.engine.program, "logs", "--tail", "5", self.container(service)], COMMAND_S
                )
            except LookupError:
                continue
            texts.append(f"--- {service}\n{done.stdout}{done.stderr}")
        return "\n".join(texts)

    def _compose(self, *words: str, within_s: float, check: bool = True) -> None:
        program = [*self.engine.compose, "--project-name", self.project]
        _run([*program, *words], within_s, check=check)


@contextmanager
def open_containers(engine: Engine) -> Iterator[Containers]:
    """Return the services of compose.yaml, and remove their containers and volumes at the end."""
    containers = Containers(engine, compose()["services"])
    try:
        yield containers
    except BaseException:
        print(containers.logs())  # noqa: T201 (pytest shows it)
        raise
    finally:
        containers.down()


def substituted(text: str) -> str:
    """Return a value of compose.yaml with its variable `${NAME:-default}` replaced."""
    found = re.fullmatch(r"\$\{(\w+):-(.*)\}", text)
    return os.environ.get(found[1]) or found[2] if found else text


def _run(words: list[str], within_s: float, *, check: bool) -> str:
    done = _done(words, within_s)
    if check and done.returncode != 0:
        text = f"{shlex.join(words)}: status {done.returncode}\n{done.stdout[-2000:]}\n"
        raise AssertionError(text + done.stderr[-4000:])
    return done.stdout


def _done(words: list[str], within_s: float) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        words,
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=within_s,
        check=False,
    )
