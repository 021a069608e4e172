"""Faults: what a file may say, and when one is due."""

from pathlib import Path

import pytest

from laneweave.launch.faults import Faults, Kill, load_faults
from laneweave.protocol.errors import BadInputError

COORDINATORS = ("c1", "c2")


def load(tmp_path: Path, text: str) -> Faults:
    path = tmp_path / "faults.toml"
    path.write_text(text, encoding="utf-8")
    return load_faults(path, COORDINATORS)


def test_no_file_is_no_faults() -> None:
    assert load_faults(None, COORDINATORS) == Faults()


def test_a_file_lists_kills(tmp_path: Path) -> None:
    found = load(tmp_path, '[[kill]]\nat_s = 3\n[[kill]]\ntarget = "c2"\nat_s = 1.5\n')
    assert found.kill == (Kill(3.0, "leader"), Kill(1.5, "c2"))


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ('[[kill]]\ntarget = "c3"\nat_s = 1.0', "kill[0].target"),
        ('[[kill]]\nat_s = 1.0\n[[kill]]\ntarget = ""\nat_s = 1.0', "kill[1].target"),
        ("[[kill]]\nat_s = -0.1", "kill[0].at_s"),
        ("[[kill]]\nat_s = inf", "kill[0].at_s"),
        ("[[kill]]\nat_s = true", "kill[0].at_s"),
        ("[[kill]]\nat_s = 1.0\nat_m = 1.0", "kill[0].at_m"),
        ("[kill]\nat_s = 1.0", "kill"),
        ("[[delay]]\nat_s = 1.0", "delay"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, field: str) -> None:
    with pytest.raises(BadInputError) as caught:
        load(tmp_path, text)
    assert str(caught.value).startswith(f"{field}: got ")


def test_the_allowed_targets_are_told(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="allowed: leader, c1, c2"):
        load(tmp_path, '[[kill]]\ntarget = "bridge"\nat_s = 1.0')


def test_a_fault_is_due_once() -> None:
    early, late = Kill(1.0), Kill(2.0, "c1")
    faults = Faults((late, early))

    assert faults.due(0.9) == ((), faults)
    due, rest = faults.due(1.0)
    assert due == (early,)
    assert rest.due(1.5) == ((), rest)
    assert rest.due(9.0) == ((late,), Faults())
