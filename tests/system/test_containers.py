"""The deployment of compose.yaml in containers: `make containers`."""

from __future__ import annotations

import json
import time
from typing import Any

import pytest

from support.engine import (
    READY_S,
    Containers,
    Engine,
    EngineUnavailableError,
    find_engine,
    open_containers,
    substituted,
)
from support.hosts import compose, lasts
from support.waiting import wait_until

RUN_S = 600.0
"""Three times the duration of the run."""
SICK_S = 20.0
"""Maximum time until a health check fails because its process hangs."""
MB = 1_000_000
SIZES_MB = {"base": 200, "agent": 330, "coordinator": 530, "sim": 900}
"""Largest size of each image, without the base image."""
TOGETHER = 1.25
"""Largest size of all images together, as a multiple of the largest one, over any base image: 1.18
over one of 300 MB, 1.21 over one of 130 MB."""
PARENT = {
    "base": "base-packages",
    "agent": "agent-packages",
    "coordinator": "agent-packages",
    "sim": "agent-packages",
}
"""The highest stage of Containerfile that each target shares with another one."""
PICTURES = {"comfort", "path_map", "road", "spacing", "speed", "travel_time"}

pytestmark = [pytest.mark.full, pytest.mark.timeout(3600)]


def test_the_deployment_runs_in_containers(capsys: pytest.CaptureFixture[str]) -> None:
    try:
        engine = find_engine()
    except EngineUnavailableError as error:
        pytest.skip(f"there is no container engine here: {error}")
    began_s = time.monotonic()
    figures = build(engine)
    figures.append(f"all images built within {time.monotonic() - began_s:.0f} s")
    with open_containers(engine) as containers:
        drive(containers)
    assert containers.left("ps", "--all") == containers.left("volume", "ls") == []
    figures.append(f"everything done within {time.monotonic() - began_s:.0f} s")
    with capsys.disabled():
        print("", *figures, sep="\n")  # noqa: T201


def drive(containers: Containers) -> None:
    """Start the deployment, stop and kill a process of each role, and check the run's end."""
    roles = [name for name, service in containers.services.items() if lasts(service)]
    # Not every engine obeys `depends_on`: start first what the bridge depends on.
    before = list(containers.services["bridge"]["depends_on"])
    containers.up(*before)
    assert containers.wait_ended("certs", 60.0) == 0
    containers.wait_healthy(*before)
    containers.up()
    containers.wait_healthy(*roles)
    check_secrets(containers)
    wait_until(lambda: status(containers).get("healthy"), READY_S)

    leader = str(status(containers)["leader"])
    for service in (
        "agents-1",
        f"coordinator-{leader.removeprefix('c')}",
        "bridge",  # in the middle: neither run ends meanwhile
        "router",
        "watch",
    ):
        check_health(containers, service, set(roles) - {service})
        containers.kill(service)
        containers.wait_healthy(*roles)
        wait_until(lambda: status(containers).get("healthy"), READY_S)

    assert containers.wait_ended("bridge", RUN_S) == 0
    wait_until(lambda: status(containers, "--no-bridge").get("healthy"), READY_S)
    check_run(containers)


def check_health(containers: Containers, service: str, others: set[str]) -> None:
    """Check that only the health check of a service fails while its process hangs."""
    with containers.frozen(service):
        wait_until(lambda: not containers.healthy(service), SICK_S)
        # Without the router nothing is known of any process.
        if service != "router":
            assert [one for one in sorted(others) if not containers.healthy(one)] == []
        if service != "watch":
            assert not status(containers).get("healthy")
    containers.wait_healthy(service)


def build(engine: Engine) -> list[str]:
    """Build all images, check their sizes, and return the sizes as text."""
    builds = {service["image"]: service["build"] for service in compose()["services"].values()}
    images = {how["target"]: image for image, how in builds.items()}
    assert images.keys() == SIZES_MB.keys()
    for image, how in builds.items():
        engine.build(how["target"], image, how["args"])
    arguments = next(iter(builds.values()))["args"]
    shared = {stage: f"laneweave-test-{stage}" for stage in PARENT.values()}
    try:
        for stage, tag in shared.items():
            engine.build(stage, tag, arguments)
        return check_sizes(engine, images, shared, substituted(arguments["BASE"]))
    finally:
        for tag in shared.values():
            engine("image", "rm", tag, check=False)


def check_sizes(
    engine: Engine, images: dict[str, str], shared: dict[str, str], base_image: str
) -> list[str]:
    """Check that images share layers and are small enough, and return their sizes as text."""
    base_size = engine.size(base_image)
    sizes = {target: engine.size(image) for target, image in images.items()}
    own = {}
    for target, image in images.items():
        below = shared[PARENT[target]]
        layers = engine.layers(below)
        assert engine.layers(image)[: len(layers)] == layers
        own[target] = sizes[target] - engine.size(below)
    largest = max(sizes.values())
    together = engine.size(shared["agent-packages"]) + sum(own.values())

    lines = [f"{target}: {size / MB:.0f} MB" for target, size in sizes.items()]
    lines.append(f"base image: {base_size / MB:.0f} MB")
    lines.append(f"together: {together / MB:.0f} MB, {together / largest:.2f} times the largest")
    for target, size in sizes.items():
        assert (size - base_size) / MB <= SIZES_MB[target], lines
    assert together <= TOGETHER * largest, lines
    return lines


def check_secrets(containers: Containers) -> None:
    """Check that every volume and every service has only the keys that it should have."""
    assert containers.files("certs") == {"./ca.pem", "./ca.key"}
    for service, how in containers.services.items():
        mounted = [volume.split(":") for volume in how["volumes"]]
        names = {name.removeprefix("certs-") for name, *_ in mounted if name.startswith("certs-")}
        for name in names:
            files = {"./ca.pem", f"./{name}.pem", f"./{name}.key"}
            assert containers.files(f"certs-{name}") == files
        if lasts(how):
            found = containers.execute(service, "find", "/certs", "-name", "*.key").split()
            assert set(found) == {f"/certs/{name}/{name}.key" for name in names}
            assert containers.execute(service, "id", "-u").strip() == "10001"


def status(containers: Containers, *options: str) -> dict[str, Any]:
    """Return what `laneweave status` reports; empty if it has no answer from the router."""
    words = ["laneweave", "status", "--config", "/scenarios/compose.toml", "--json", *options]
    text = containers.execute("agents-2", *words, check=False)
    found: dict[str, Any] = json.loads(text) if text else {}
    return found


def check_run(containers: Containers) -> None:
    """Check the volume `runs`: the run of the killed bridge, and a complete one after it."""
    killed, folder = sorted(containers.in_volume("runs", "ls").split())
    first, summary = (
        json.loads(containers.in_volume("runs", "cat", f"{run}/summary.json"))
        for run in (killed, folder)
    )
    vehicles = summary["vehicles"]
    assert (first["ending"], summary["ending"]) == ("unfinished", "complete")
    assert vehicles["left"] == vehicles["entered"] == vehicles["demanded"] > 0
    assert summary["safety"]["overlaps"] == 0
    pictures = {f"./{folder}/{name}.png" for name in PICTURES}
    assert pictures | {f"./{folder}/report.html"} <= containers.files("runs")
