"""Implementations by name: built in, of other distributions, and those that are refused."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.plug_ins import PlugIns
from support.plug_ins import Install, installing

GROUP = "laneweave.things"
THINGS = PlugIns(
    "thing",
    GROUP,
    {"decoder": "json:JSONDecoder", "dumps": "json:dumps"},
    reserved=frozenset({"all"}),
)


@pytest.fixture
def install(tmp_path: Path) -> Iterator[Install]:
    with installing(tmp_path / "installed", GROUP) as install:
        yield install


def test_built_in_and_plugged_in_things_are_loaded_alike(install: Install) -> None:
    install("mine", {"own": "Own", "made": "made"}, "class Own: ...\nmade = Own()\n")
    assert THINGS.names() == ("decoder", "dumps", "made", "own")
    assert type(THINGS.load("own", "x")).__name__ == "Own"
    assert THINGS.load("made", "x") is THINGS.load("made", "x")
    assert THINGS.load("decoder", "x").decode("1") == 1
    assert THINGS.load("dumps", "x")(1) == "1"
    assert [THINGS.origin(name) for name in ("own", "dumps", "no")] == ["mine 1.2", "", ""]


def test_an_unknown_name_is_refused_with_the_one_that_is_meant(install: Install) -> None:
    install("mine", {"greedy": "x"}, "x = 1")
    with pytest.raises(BadInputError, match=r"^--thing: got 'gredy'; .*decoder, dumps, greedy,.*"):
        THINGS.checked("gredy", "--thing")
    with pytest.raises(BadInputError, match=r"did you mean greedy\?"):
        THINGS.load("gredy", "--thing")


def test_built_in_and_reserved_names_cannot_be_taken(install: Install) -> None:
    install("mine", {"dumps": "x", "all": "x", "not a name": "x"}, "x = 1")
    assert THINGS.names() == ("decoder", "dumps")
    assert THINGS.load("dumps", "x")(1) == "1"
    assert THINGS.origin("dumps") == ""
    with pytest.raises(BadInputError, match="all"):
        THINGS.checked("all", "x")


def test_a_name_of_two_distributions_is_refused(install: Install) -> None:
    install("mine", {"own": "x"}, "x = 1")
    install("other", {"own": "x"}, "x = 1")
    with pytest.raises(BadInputError, match=r"mine 1\.2 and other 1\.2|other 1\.2 and mine 1\.2"):
        THINGS.checked("own", "x")


@pytest.mark.parametrize(
    ("source", "reason"),
    [("x = 1", "AttributeError"), ("import nothing_like_it", "nothing_like_it"), ("1 / 0", "Zero")],
)
def test_a_plug_in_that_cannot_be_loaded_is_refused(
    install: Install, source: str, reason: str
) -> None:
    install("mine", {"own": "Own"}, source)
    assert THINGS.checked("own", "x") == "own"
    with pytest.raises(BadInputError, match=rf"^x: got 'own'; .*that of mine 1\.2 fails.*{reason}"):
        THINGS.load("own", "x")
