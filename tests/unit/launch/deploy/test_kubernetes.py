"""deploy/kubernetes is valid, and is the deployment of compose.yaml."""

from __future__ import annotations

import re
import shlex
from copy import deepcopy
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from laneweave.protocol.config.participants import identities_of
from laneweave.protocol.config.scenario_files import load_scenario
from support.commands import parameters
from support.tables import for_each

ROOT = Path(__file__).resolve().parents[4]
BASE = ROOT / "deploy" / "kubernetes"
SERVICES: dict[str, dict[str, Any]] = yaml.safe_load(
    (ROOT / "compose.yaml").read_text(encoding="utf-8")
)["services"]
SCENARIO = load_scenario(ROOT / "scenarios" / "compose.toml")
VERSIONS = ("1.31", "1.37")
"""The first one in which a StatefulSet may count from 1 without a feature gate, and the newest."""


def kustomization(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((folder / "kustomization.yaml").read_text())
    return found


def resources() -> list[dict[str, Any]]:
    names = [name for name in kustomization(BASE)["resources"] if name.endswith(".yaml")]
    assert {path.name for path in BASE.glob("*.yaml")} == {*names, "kustomization.yaml"}
    return [found for name in names for found in yaml.safe_load_all((BASE / name).read_text())]


RESOURCES = {f"{found['kind']}/{found['metadata']['name']}": found for found in resources()}
WORKLOADS = {
    name: found for name, found in RESOURCES.items() if "template" in found.get("spec", {})
}
PODS = {
    # (workload, ordinal): the services of compose.yaml with the same role
    ("Deployment/router", 0): "router",
    ("Deployment/watch", 0): "watch",
    ("Job/bridge", 0): "bridge",
    **{("StatefulSet/coordinator", number): f"coordinator-{number}" for number in (1, 2, 3)},
    **{("StatefulSet/agents", number): f"agents-{number}" for number in (1, 2)},
}
each_pod = for_each(("workload", "ordinal"), sorted(PODS))
each_resource = for_each("name", sorted(RESOURCES))


def pod(workload: str) -> dict[str, Any]:
    found: dict[str, Any] = WORKLOADS[workload]["spec"]["template"]["spec"]
    return found


def container(workload: str) -> dict[str, Any]:
    (found,) = pod(workload)["containers"]
    return dict(found)


def words(text: list[str], workload: str, ordinal: int) -> list[str]:
    """Return the command that the pod with this ordinal executes, as words."""
    values = {"ORDINAL": str(ordinal), "POD": f"{workload.partition('/')[2]}-{ordinal}"}
    if text[:2] == ["sh", "-c"]:
        script = re.sub(
            r"\$\(\((.*?)\)\)", lambda match: str(_difference(match[1], ordinal)), text[2]
        )
        return shlex.split(re.sub(r"\$(\w+)", lambda match: values[match[1]], script))
    return [re.sub(r"\$\((\w+)\)", lambda match: values[match[1]], word) for word in text]


def _difference(text: str, ordinal: int) -> int:
    found = re.fullmatch(r"ORDINAL - (\d+)", text)
    assert found is not None
    return ordinal - int(found[1])


@each_resource
@pytest.mark.parametrize("version", VERSIONS)
def test_resources_are_valid(name: str, version: str) -> None:
    kubernetes_validate.validate(RESOURCES[name], version, strict=True)


def test_a_misspelt_field_is_not_valid() -> None:
    wrong = deepcopy(RESOURCES["Deployment/router"])
    wrong["spec"]["template"]["spec"]["containers"][0]["readynessProbe"] = {}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(wrong, VERSIONS[-1], strict=True)


def test_every_service_that_lasts_has_its_pod() -> None:
    lasting = {name for name, service in SERVICES.items() if service["restart"] != "no"}
    assert sorted(PODS.values()) == sorted(lasting)
    assert {workload for workload, _ in PODS} == WORKLOADS.keys()
    counted = [(name, found["spec"].get("replicas", 1)) for name, found in WORKLOADS.items()]
    assert sorted(counted) == sorted(
        (name, sum(workload == name for workload, _ in PODS)) for name in WORKLOADS
    )
    for name in ("StatefulSet/coordinator", "StatefulSet/agents"):
        assert WORKLOADS[name]["spec"]["ordinals"] == {"start": 1}


@each_pod
def test_pods_run_the_commands_of_compose(workload: str, ordinal: int) -> None:
    service, found = SERVICES[PODS[workload, ordinal]], container(workload)
    assert found["image"] == service["image"]
    command = words(found["command"], workload, ordinal)
    program, *given = command
    assert program == "laneweave"
    if workload != "Deployment/watch":
        *given, option, address = given
        assert (option, address) == ("--metrics", "0.0.0.0:9100")
        assert found["livenessProbe"]["httpGet"] == {"path": "/metrics", "port": 9100}
        check = words(found["readinessProbe"]["exec"]["command"], workload, ordinal)
        assert parameters(check[1:]) == parameters(service["healthcheck"]["test"][2:])
    assert parameters(given) == parameters(service["command"])


@each_pod
def test_a_container_sees_only_its_own_certificate_and_that_of_its_check(
    workload: str, ordinal: int
) -> None:
    volumes = {volume["name"]: volume for volume in pod(workload)["volumes"]}
    seen = set()
    for mount in container(workload)["volumeMounts"]:
        volume, place = volumes[mount["name"]], Path(mount["mountPath"])
        if "secret" in volume:
            identity = volume["secret"]["secretName"].removeprefix("certs-")
            assert place == Path(SCENARIO.security.folder) / identity
            seen.add(identity)
        if "projected" in volume:
            own = words([mount["subPathExpr"]], workload, ordinal)[0]
            assert place == Path(SCENARIO.security.folder)
            paths = {
                Path(item["path"])
                for source in volume["projected"]["sources"]
                for item in source["secret"]["items"]
                if Path(item["path"]).name == item["key"]
            }
            names = {path.name for path in paths if path.parts[0] == own}
            keys = {Path(name).stem for name in names if name.endswith(".key")}
            assert names == {"ca.pem"} | {f"{key}{end}" for key in keys for end in (".pem", ".key")}
            seen |= keys
    mounted = [volume.partition(":")[0] for volume in SERVICES[PODS[workload, ordinal]]["volumes"]]
    expected = {name.removeprefix("certs-") for name in mounted if name.startswith("certs-")}
    assert seen == expected
    assert seen <= {identity.common_name for identity in identities_of(SCENARIO)}


@for_each("workload", sorted(WORKLOADS))
def test_containers_have_no_rights_to_misuse(workload: str) -> None:
    found = pod(workload)
    assert found["automountServiceAccountToken"] is False
    assert found["securityContext"]["runAsNonRoot"] is True
    assert f"--uid {found['securityContext']['runAsUser']} " in (ROOT / "Containerfile").read_text()
    for one in _all_containers(found):
        assert one["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert one["resources"]["requests"].keys() == {"cpu", "memory"}


def test_the_configuration_is_that_of_compose() -> None:
    assert "../../scenarios" in kustomization(BASE)["resources"]
    (generated,) = kustomization(ROOT / "scenarios")["configMapGenerator"]
    assert generated == {"name": "scenarios", "files": ["compose.toml"]}
    for workload in WORKLOADS:
        volumes = {volume["name"]: volume for volume in pod(workload)["volumes"]}
        assert volumes["scenarios"] == {"name": "scenarios", "configMap": {"name": "scenarios"}}


def test_images_can_be_replaced() -> None:
    used = {one["image"] for name in WORKLOADS for one in _all_containers(pod(name))}
    assert {image["name"] for image in kustomization(BASE)["images"]} == used


def test_roles_reach_the_router_and_nothing_else() -> None:
    names = {name for name in RESOURCES if name.startswith("NetworkPolicy/")}
    assert names == {
        "NetworkPolicy/default-deny",
        "NetworkPolicy/roles-to-router",
        "NetworkPolicy/router-from-roles",
    }
    (port,) = {int(listen.rpartition(":")[2]) for listen in SCENARIO.network.listen}
    (ingress,) = RESOURCES["NetworkPolicy/router-from-roles"]["spec"]["ingress"]
    egress = RESOURCES["NetworkPolicy/roles-to-router"]["spec"]["egress"][0]
    expected = [{"protocol": protocol, "port": port} for protocol in ("TCP", "UDP")]
    assert ingress["ports"] == egress["ports"] == expected
    service = RESOURCES["Service/router"]["spec"]
    assert [
        {"protocol": one["protocol"], "port": one["port"]} for one in service["ports"]
    ] == expected


def _all_containers(found: dict[str, Any]) -> list[dict[str, Any]]:
    return [*found["containers"], *found.get("initContainers", ())]
