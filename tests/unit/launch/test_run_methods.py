"""Methods of users among the built-in ones: labels, settings that count, versions in sweeps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from attrs import evolve

from laneweave.launch.recordings.runs import Run, write_point
from laneweave.launch.run_methods import (
    FORMATION,
    METHODS,
    REFERENCE_METHODS,
    affects,
    checked_method,
    labelled,
    parse_methods,
    reference_method,
)
from laneweave.launch.sweep.folder import SweepFolder
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from support.plug_ins import Install, installing


@pytest.fixture
def install(tmp_path: Path) -> Iterator[Install]:
    with installing(tmp_path / "installed", REFERENCE_METHODS.group) as install:
        yield install


def test_every_built_in_reference_method_has_a_label() -> None:
    assert {one.method for one in METHODS.values()} == {FORMATION, *REFERENCE_METHODS.built_in}
    for name in REFERENCE_METHODS.built_in:
        assert METHODS[name].method == name
        reference_method(name).check(Scenario())


def test_a_plug_in_is_a_label_of_its_own(install: Install) -> None:
    source = "from laneweave.methods import RuleMethod\nclass Own(RuleMethod): pass\nwrong = 1\n"
    install("mine", {"own": "Own", "wrong": "wrong", "rolling": "Own"}, source)
    assert checked_method("own", "--method") == "own"
    assert parse_methods("rule,own") == ("rule", "own")
    assert labelled("own").method == "own"
    assert labelled("own").settings(Scenario()) == Scenario()
    assert type(reference_method("own")).__name__ == "Own"
    assert labelled("rolling").method == FORMATION
    with pytest.raises(BadInputError, match=r"a ReferenceMethod; that of mine 1\.2 is none"):
        reference_method("wrong")
    with pytest.raises(BadInputError, match=r"one of formation, rule, lc2013, own.*mean own\?"):
        checked_method("owm", "--method")


def test_any_setting_may_change_the_results_of_a_plug_in() -> None:
    assert affects("rule.headway_s", "own")
    assert affects("formation.gap_m", "own")
    assert not affects("observation.metrics", "own")
    assert not affects("rule.headway_s", "lc2013")


@pytest.mark.parametrize(("made_with", "fits"), [("mine 1.2", True), ("", True), ("mine 1", False)])
def test_a_sweep_continues_with_the_version_of_its_points(
    install: Install, tmp_path: Path, made_with: str, fits: bool
) -> None:
    folder = tmp_path / "sweep"
    SweepFolder(folder).__exit__()
    point = folder / "own-1000-1"
    point.mkdir()
    run = Run(point, "own", "own", Scenario(), None, wall_s=1.0, plug_in=made_with)
    write_point(run, point)
    with SweepFolder(folder) as sweep:
        assert sweep.runs["own-1000-1"] == evolve(run)
        sweep.check_settings(Scenario())  # not installed: nothing is known
        install("mine", {"own": "x"}, "x = 1")
        if fits:
            sweep.check_settings(Scenario())
        else:
            with pytest.raises(BadInputError, match=r"version of own: got 'mine 1\.2'.*mine 1,"):
                sweep.check_settings(Scenario())
