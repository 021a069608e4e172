"""Credentials that are not in order are found before they are used."""

from __future__ import annotations

import shutil
from pathlib import Path

import attrs
import pytest
import structlog

from laneweave.launch.deploy.certificate_authority import issue, load_authority, make_authority
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.security.certificates import check_credentials, examine
from laneweave.protocol.security.connection import Credentials
from laneweave.protocol.wire.identities import parse_identity
from support.refusals import refusal

NAME = "coordinator.c1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of two who take part, and of the router."""
    folder = tmp_path_factory.mktemp("certs")
    authority = make_authority(folder)
    for name in (NAME, "vehicle.v1"):
        issue(authority, folder, parse_identity(name), days=30.0)
    hosts = ("router.example", "10.1.2.3")
    issue(authority, folder, parse_identity("router"), days=30.0, hosts=hosts)
    return folder


def credentials(folder: Path, name: str = NAME) -> Credentials:
    return Credentials(str(folder / "ca.pem"), str(folder / f"{name}.pem"),
                       str(folder / f"{name}.key"))  # fmt: skip


def refused(given: Credentials, identity: str = NAME, host: str = "") -> BadInputError:
    return refusal(examine, given, identity, host)


def test_valid_credentials_have_no_warnings(folder: Path) -> None:
    assert examine(credentials(folder), NAME).warnings == ()
    for host in ("", "router.example", "10.1.2.3", "localhost", "127.0.0.1", "::1"):
        assert examine(credentials(folder, "router"), "router", host).warnings == ()


def test_the_private_key_may_be_given_as_text(folder: Path) -> None:
    text = (folder / f"{NAME}.key").read_text()
    given = attrs.evolve(credentials(folder), private_key="", private_key_pem=text)
    assert examine(given, NAME).warnings == ()
    other = (folder / "vehicle.v1.key").read_text()
    error = refused(attrs.evolve(given, private_key_pem=other))
    assert error.field == "private key"
    assert other.splitlines()[1] not in str(error)
    assert refused(attrs.evolve(given, private_key_pem="nonsense")).field == "certificate"


@pytest.mark.parametrize(
    ("part", "field"),
    [("ca", "certificate authority"), ("certificate", "certificate"),
     ("private_key", "private key")],
)  # fmt: skip
@pytest.mark.parametrize("content", [None, b"", b"text", b"\0\xff"])
def test_a_missing_or_malformed_file_is_refused(
    folder: Path, tmp_path: Path, part: str, field: str, content: bytes | None
) -> None:
    path = tmp_path / "file"
    if content is not None:
        path.write_bytes(content)
    error = refused(attrs.evolve(credentials(folder), **{part: str(path)}))
    assert error.field == field
    assert str(path) in str(error.value)


@pytest.mark.parametrize("part", ["ca", "certificate", "private_key"])
def test_an_empty_certificate_is_refused(folder: Path, tmp_path: Path, part: str) -> None:
    path = tmp_path / "file"
    path.write_text("-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n")
    refused(attrs.evolve(credentials(folder), **{part: str(path)}))


def test_a_certificate_or_key_of_another_identity_is_refused(folder: Path) -> None:
    error = refused(credentials(folder), "coordinator.c2")
    assert error.field == "certificate"
    assert "this one is for coordinator.c1" in error.allowed
    wrong_key = attrs.evolve(
        credentials(folder), private_key=credentials(folder, "vehicle.v1").private_key
    )
    assert refused(wrong_key).field == "private key"


def test_a_certificate_of_another_authority_is_refused(folder: Path, tmp_path: Path) -> None:
    issue(make_authority(tmp_path), tmp_path, parse_identity(NAME), days=30.0)
    mixed = attrs.evolve(credentials(tmp_path), ca=str(folder / "ca.pem"))
    assert "has signed" in refused(mixed).allowed


def test_an_expired_certificate_is_refused(folder: Path, tmp_path: Path) -> None:
    issue(load_authority(folder), tmp_path, parse_identity(NAME), days=-1.0)
    shutil.copy(folder / "ca.pem", tmp_path)
    assert "expired" in refused(credentials(tmp_path)).allowed


def test_what_ends_soon_or_lies_open_is_warned_of(folder: Path, tmp_path: Path) -> None:
    issue(load_authority(folder), tmp_path, parse_identity(NAME), days=3.0)
    shutil.copy(folder / "ca.pem", tmp_path)
    (tmp_path / f"{NAME}.key").chmod(0o640)
    first, second = examine(credentials(tmp_path), NAME).warnings
    assert "expires in 3.0 days" in first
    assert "is readable by other users" in second
    # A role that waits for its router asks again and again.
    with structlog.testing.capture_logs() as logged:
        for _ in range(3):
            check_credentials(credentials(tmp_path), NAME)
    assert len(logged) == 2


def test_the_router_is_where_clients_look_for_it(folder: Path) -> None:
    error = refused(credentials(folder, "router"), "router", "elsewhere.example")
    assert "elsewhere.example" in error.allowed
    refused(credentials(folder, "router"), "router", "10.1.2.4")


def test_certificates_of_router_and_clients_are_not_interchangeable(folder: Path) -> None:
    """The router's certificate is of no use to a client, and the other way round."""
    assert "purpose" in refused(credentials(folder, "router"), NAME).allowed
    assert "purpose" in refused(credentials(folder), "router").allowed
