"""`laneweave certs` and `laneweave config check`, in this process."""

from __future__ import annotations

import shutil
import stat
from pathlib import Path

import pytest

from laneweave.launch.deploy.config_check import Report, check_deployment
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.wire.identities import parse_identity
from support.commands import Here
from support.tables import for_each

DEPLOYMENT = """
[network]
endpoint = "tls/10.1.2.3:7447"
listen = ["tls/0.0.0.0:7447"]
[runtime]
coordinators = 2
[security]
mode = "mtls"
fleets = { left = "0/2", right = ["x"] }
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "deployment.toml"
    path.write_text(DEPLOYMENT)
    return path


@pytest.mark.slow
def test_certificates_for_a_deployment(laneweave: Here, config: Path) -> None:
    folder = config.parent / "certs"
    more = ("--config", config, "--host", "router.example")
    status, out, errors = laneweave("certs", "init", folder, *more)
    assert (status, errors) == (0, [])
    names = {path.stem for path in folder.glob("*.pem")}
    assert names == {"ca", "router", "bridge", "coordinator.c1", "coordinator.c2", "fleet.left",
                     "fleet.right", "client.plan", "operator.operator", "observer.ping",
                     "observer.status", "observer.watch"}  # fmt: skip
    for name in names:
        assert stat.S_IMODE((folder / f"{name}.key").stat().st_mode) == 0o600
        assert name == "ca" or name in out
    for role, name in (("router", ""), ("bridge", ""), ("coordinator", "c2"), ("fleet", "left"),
                       ("client", "plan"), ("observer", "ping")):  # fmt: skip
        status, out, errors = laneweave("config", "check", config, "--role", role, "--name", name)
        assert (status, errors) == (0, []), (role, errors)
        assert "valid until" in out
    report = check_deployment(load_scenario(config), parse_identity("router"), {})
    assert (report.problems, report.warnings) == ([], [])


def test_what_is_missing_is_made_and_what_is_there_kept(laneweave: Here, config: Path) -> None:
    folder = config.parent / "certs"
    init = ("certs", "init", folder, "--config", config)
    assert laneweave(*init, "--keep")[0] == 0
    made = {path.name: path.read_bytes() for path in folder.iterdir()}
    (folder / "bridge.pem").unlink()
    status, out, errors = laneweave(*init, "--keep")
    assert (status, errors) == (0, [])
    assert "1 certificates" in out
    changed = {path.name for path in folder.iterdir() if path.read_bytes() != made[path.name]}
    assert changed == {"bridge.pem", "bridge.key"}
    status, _, errors = laneweave("config", "check", config, "--role", "bridge")
    assert (status, errors) == (0, [])


def test_each_identity_has_a_folder_that_is_enough_for_it(laneweave: Here, config: Path) -> None:
    folder, elsewhere = config.parent / "authority", config.parent / "certs"
    init = ("certs", "init", folder, "--config", config, "--separate")
    assert laneweave(*init)[0] == 0
    assert laneweave("certs", "add", folder, "client.ops", "--separate")[0] == 0
    assert {path.name for path in folder.iterdir() if path.is_file()} == {"ca.pem", "ca.key"}
    for own in filter(Path.is_dir, folder.iterdir()):
        made = {path.name for path in own.iterdir()}
        assert made == {"ca.pem", f"{own.name}.pem", f"{own.name}.key"}
    shutil.copytree(folder / "coordinator.c2", elsewhere / "coordinator.c2")
    check = ("config", "check", config, "--role", "coordinator", "--name")
    assert laneweave(*check, "c2")[0] == 0
    assert laneweave(*check, "c1")[0] == 2

    shutil.rmtree(folder / "bridge")
    (folder / "bridge").mkdir()  # as a new volume
    status, out, errors = laneweave(*init, "--keep")
    assert (status, errors) == (0, [])
    assert "1 certificates" in out
    assert (folder / "bridge" / "ca.pem").read_bytes() == (folder / "ca.pem").read_bytes()


def test_an_authority_that_lacks_a_file_is_not_replaced(laneweave: Here, tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    assert laneweave("certs", "init", folder)[0] == 0
    (folder / "ca.pem").unlink()
    for options in ([], ["--keep"]):
        refused = laneweave.refused("certs", "init", folder, *options)
        assert "without ca.pem and ca.key; or with both, and --keep" in refused


def test_one_more_certificate(laneweave: Here, tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    assert laneweave("certs", "init", folder)[0] == 0
    assert laneweave("certs", "add", folder, "vehicle.x")[0] == 0
    assert (folder / "vehicle.x.pem").exists()
    assert "certificate" in laneweave.refused("certs", "add", folder, "vehicle.x")


def test_what_cannot_be_certified(laneweave: Here, tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    assert laneweave("certs", "init", folder)[0] == 0
    there = set(folder.rglob("*"))
    for words, named in (
        ("add FOLDER tram.x", "IDENTITY"),
        ("add FOLDER vehicle.../../x", "IDENTITY"),
        ("add FOLDER vehicle.x --host h", "--host"),
        ("add FOLDER vehicle.x --days 0", "--days"),
        ("add FOLDER vehicle.x --days nan", "--days"),
        ("add FOLDER/none vehicle.x", "DIR"),
        ("init FOLDER", "DIR"),
        ("init FOLDER/new --host é", "--host"),
        ("init FOLDER/ca.pem/below", "DIR"),
    ):
        line = laneweave.refused("certs", *words.replace("FOLDER", str(folder)).split())
        assert line.startswith(f"{named}: ")
        assert set(folder.rglob("*")) == there


def checked(text: str, identity: str | None, folder: Path) -> Report:
    path = folder / "deployment.toml"
    path.write_text(text)
    who = None if identity is None else parse_identity(identity)
    return check_deployment(load_scenario(path), who, {})


def test_all_problems_are_reported_at_once(laneweave: Here, tmp_path: Path) -> None:
    path = tmp_path / "deployment.toml"
    path.write_text('[network]\nendpoint = "tcp/x"\nlisten = ["ws/y:1", "tcp/z:1"]\n')
    status, out, errors = laneweave("config", "check", path)
    assert (status, out) == (2, "")
    problems = [line for line in errors if not line.startswith("warning: ")]
    assert [line.partition(":")[0] for line in problems] == ["network.endpoint", "network.listen"]
    assert [line[-len("toml:2)") :] for line in problems] == ["toml:2)", "toml:3)"]


@for_each(
    ("endpoint", "listen", "fits"),
    [
        ("udp/127.0.0.1:1?rel=0", "udp/127.0.0.1:1?rel=0", True),
        ("udp/127.0.0.1:1?rel=0", "udp/127.0.0.1:1", False),
        ("udp/127.0.0.1:1", "tcp/127.0.0.1:1", False),
    ],
)
def test_both_ends_of_a_link_have_its_protocol_and_options(
    tmp_path: Path, endpoint: str, listen: str, *, fits: bool
) -> None:
    text = f'network.endpoint = "{endpoint}"\nnetwork.listen = ["{listen}"]'
    problems = checked(text, None, tmp_path).problems
    assert [problem.field for problem in problems] == [] if fits else ["network.listen"]


def test_a_file_that_does_not_load(laneweave: Here, tmp_path: Path) -> None:
    path = tmp_path / "deployment.toml"
    path.write_text("[network]\nendpiont = 'tcp/x:1'\n")
    assert laneweave.refused("config", "check", path).startswith("network.endpiont")


@for_each(
    ("identity", "problem"),
    [
        ("coordinator.c9", "an identity of this configuration"),
        ("vehicle.v0001", "No such file"),
        ("router", "No such file"),
    ],
)
def test_wrong_files_of_a_role_are_reported(tmp_path: Path, identity: str, problem: str) -> None:
    found = str(*checked(DEPLOYMENT, identity, tmp_path).problems)
    assert problem in found


def test_odd_settings_cause_warnings(tmp_path: Path) -> None:
    assert checked('network.endpoint = "tcp/127.0.0.1:1"', None, tmp_path).warnings == []
    (line,) = checked('network.endpoint = "tcp/10.0.0.1:1"', None, tmp_path).warnings
    assert line.startswith("security.mode: off")
    shared = DEPLOYMENT.replace('["x"]', '["v0001", "v0002", "v0003", "v0004"]')
    (line,) = checked(shared, None, tmp_path).warnings
    assert line.startswith("security.fleets: ")


def test_names_need_roles(laneweave: Here, config: Path) -> None:
    for more in (("--name", "c1"), ("--role", "coordinator"), ("--role", "tram")):
        laneweave.refused("config", "check", config, *more)
    laneweave.refused("config", "check", config.parent / "none.toml")
