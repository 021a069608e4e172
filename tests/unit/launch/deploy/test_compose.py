"""compose.yaml and Containerfile agree with the code, as far as that shows without an engine."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from laneweave.protocol.config.participants import identities_of
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.scenario.fields import Scenario
from support.commands import parameters
from support.extras import EXTRA_OF_ROLE, PROJECT
from support.tables import for_each

ROOT = Path(__file__).resolve().parents[4]
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
CONTAINERFILE = (ROOT / "Containerfile").read_text(encoding="utf-8")
STAGES = {
    name: (parent, text)
    for parent, name, text in re.findall(
        r"^FROM (\S+) AS (\S+)\n(.*?)(?=^FROM |\Z)", CONTAINERFILE, re.MULTILINE | re.DOTALL
    )
}
"""The stage below each stage, and its instructions."""
LARGE = {"plan", "sim"}
WRITABLE = re.compile(r"^[\w.-]+:(?P<target>/[\w/.-]+)$")
"""A named volume that may be written to."""

each_service = for_each("service", sorted(SERVICES))


def role(service: str) -> str:
    name: str = SERVICES[service]["command"][0]
    return name


def instructions(service: str) -> str:
    """Return the instructions for a service's image, the lowest stage first."""
    text, stage = "", SERVICES[service]["build"]["target"]
    while stage in STAGES:
        stage, above = STAGES[stage]
        text = above + text
    assert stage == "$BASE"
    return text


def extras(service: str) -> set[str]:
    """Return the extras whose packages a service's image contains."""
    installed = r"^RUN python \S+/install_extras\.py \S+([\w ]*)"
    found = re.findall(installed, instructions(service), re.MULTILINE)
    return {extra for extras in found for extra in extras.split()}


def identity(service: str) -> str:
    """Return the common name of a service's certificate."""
    given = parameters(SERVICES[service]["command"])
    names = {
        "coordinator": f"coordinator.{given.get('name')}",
        "agent": f"fleet.{given.get('fleet')}",
        "watch": "observer.watch",
    }
    return names.get(role(service), role(service))


def certificates(service: str) -> dict[str, str]:
    """Return the volumes of certificates that a service mounts, with their places."""
    mounted = (volume.partition(":") for volume in SERVICES[service]["volumes"])
    return {name: place for name, _, place in mounted if name.startswith("certs")}


def port_of(service: str) -> str:
    """Return the port at which the live page is served, for containers and for this host alike."""
    listen: str = parameters(SERVICES[service]["command"]).get("listen", "")
    _, _, port = listen.rpartition(":")
    assert SERVICES[service].get("ports", []) == ([f"127.0.0.1:{port}:{port}"] if port else [])
    return port


def once(service: str) -> bool:
    return SERVICES[service].get("restart") == "no"


def check(service: str) -> list[str]:
    """Return the words of a health check, if it is one of the program's own."""
    kind, program, *words = SERVICES[service].get("healthcheck", {"test": ["CMD", "none"]})["test"]
    assert kind == "CMD"
    return words if program == "laneweave" else []


def configuration() -> Scenario:
    return load_scenario(ROOT / "scenarios" / "compose.toml")


@each_service
def test_commands_exist_and_read_the_one_configuration(service: str) -> None:
    for words in filter(None, (SERVICES[service]["command"], check(service))):
        config = parameters(words).get("config")
        if config is not None:
            assert (ROOT / config.relative_to("/")).is_file()
    assert once(service) or parameters(SERVICES[service]["command"])["config"] is not None


@each_service
def test_permanent_services_have_health_checks_and_restart(service: str) -> None:
    if once(service):
        return
    found = SERVICES[service]
    # The bridge is done when all vehicles have left.
    assert found["restart"] == ("on-failure:3" if service == "bridge" else "unless-stopped")
    asks_itself = f"127.0.0.1:{port_of(service)}" in found["healthcheck"]["test"][-1]
    assert asks_itself if service == "watch" else check(service)


@each_service
def test_images_have_what_their_role_needs_and_nothing_large_beside_it(service: str) -> None:
    known = set(PROJECT["optional-dependencies"])
    needed = {extra} if (extra := EXTRA_OF_ROLE.get(role(service))) else set()
    assert needed <= extras(service) <= known - {"all", "dev", "dask"}
    assert not extras(service) & (LARGE - needed)
    assert SERVICES[service]["image"] == f"laneweave-{SERVICES[service]['build']['target']}"
    compiles = "laneweave compile" in instructions(service)
    assert compiles == (role(service) == "coordinator")


def test_the_base_image_is_an_argument() -> None:
    (default,) = re.findall(r"^ARG BASE=(\S+)$", CONTAINERFILE, re.MULTILINE)
    for service in SERVICES.values():
        assert service["build"]["args"]["BASE"] == f"${{LANEWEAVE_BASE_IMAGE:-{default}}}"


@each_service
def test_containers_have_no_rights_to_misuse(service: str) -> None:
    found = SERVICES[service]
    assert found["read_only"] is True
    assert found["init"] is True
    assert found["cap_drop"] == ["ALL"]
    assert found["security_opt"] == ["no-new-privileges:true"]
    assert "/tmp" in found["tmpfs"]  # noqa: S108 (in the container)
    users = re.findall(r"^USER (\S+)$", instructions(service), re.MULTILINE)
    assert users == ["laneweave"]


@each_service
def test_dependencies_are_services_that_can_be_waited_for(service: str) -> None:
    for name, how in SERVICES[service].get("depends_on", {}).items():
        if how["condition"] == "service_completed_successfully":
            assert once(name)
        else:
            assert how["condition"] == "service_healthy"
            assert "healthcheck" in SERVICES[name]


@each_service
def test_what_a_volume_covers_is_in_the_image_and_belongs_to_the_user(service: str) -> None:
    made = set(" ".join(re.findall(r"mkdir -p ([^&\\]+)", instructions(service))).split())
    named = SERVICES[service]["build"]["args"]["IDENTITIES"].split()
    made |= {f"/certs/{identity}" for identity in named}
    for volume in SERVICES[service]["volumes"]:
        if not volume.startswith("./"):
            assert volume.partition(":")[0] in COMPOSE["volumes"]
            assert volume.split(":")[1] in made
        if match := WRITABLE.match(volume):
            assert match["target"] in made
        else:
            assert volume.endswith(":ro")


def test_the_planner_finds_its_compiled_code() -> None:
    place = re.search(r"NUMBA_CACHE_DIR=(\S+)", CONTAINERFILE)
    assert place is not None
    for service in SERVICES:
        if role(service) == "coordinator":
            assert f"compiled:{place[1]}" in SERVICES[service]["volumes"]


def test_the_router_is_found_by_its_service_name_whenever_it_comes() -> None:
    network = configuration().network
    host, port = re.fullmatch(r"\w+/([\w-]+):(\d+)", network.endpoint).groups()  # type: ignore[union-attr]
    assert role(host) == "router"
    assert [listen.partition("/")[2] for listen in network.listen] == [f"0.0.0.0:{port}"]
    assert network.connect_timeout_s > 10.0


def test_every_fleet_has_one_container_that_looks_at_its_own_health() -> None:
    fleets = configuration().security.fleets
    agents = {
        parameters(service["command"])["fleet"]: service
        for name, service in SERVICES.items()
        if role(name) == "agent"
    }
    assert agents.keys() == fleets.keys()
    for fleet, service in agents.items():
        assert parameters(service["healthcheck"]["test"][2:])["shard"] == fleets[fleet]
    shards = sorted(str(shard) for shard in fleets.values())
    assert shards == [f"{index}/{len(shards)}" for index in range(len(shards))]


def test_every_coordinator_has_one_container_that_looks_at_its_own_health() -> None:
    names = []
    for name, service in SERVICES.items():
        if role(name) == "coordinator":
            names.append(parameters(service["command"])["name"])
            assert parameters(service["healthcheck"]["test"][2:])["name"] == names[-1]
    assert names == [f"c{number + 1}" for number in range(configuration().runtime.coordinators)]


def test_only_the_service_that_makes_certificates_mounts_the_key_of_the_authority() -> None:
    security = configuration().security
    assert security.mode == "mtls"
    for service in SERVICES:
        assert ("certs" in certificates(service)) == (role(service) == "certs")
    names = [identity.common_name for identity in identities_of(configuration())]
    places = {f"certs-{name}": f"{security.folder}/{name}" for name in names if not vehicle(name)}
    assert certificates("certs") == {"certs": security.folder} | places
    assert SERVICES["certs"]["build"]["args"]["IDENTITIES"].split() == [
        name for name in names if not vehicle(name)
    ]


def vehicle(name: str) -> bool:
    return name.startswith("vehicle.")


@each_service
def test_a_role_mounts_its_own_certificate_and_that_of_its_health_check(service: str) -> None:
    if role(service) == "certs":
        return
    names = {identity(service)} | {f"observer.{word}" for word in check(service)[:1]}
    folder = configuration().security.folder
    assert certificates(service) == {f"certs-{name}": f"{folder}/{name}:ro" for name in names}


def test_the_image_is_made_of_files_that_exist() -> None:
    for sources in re.findall(r"^COPY (?!--from)(.+) \S+$", CONTAINERFILE, re.MULTILINE):
        assert all((ROOT / source).exists() for source in sources.split())
    needed = re.findall(r"lib\w+[\d-]*\d", (ROOT / "README.md").read_text(encoding="utf-8"))
    (debian,) = re.findall(r"--no-install-recommends \\\n\s+([^\\]+) \\", CONTAINERFILE)
    (unpacked,) = re.findall(r"apt-get download (\S+)", CONTAINERFILE)
    assert {*debian.split(), unpacked} == set(needed)
