"""Tests of single runs of the evaluation: which of them count."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.trials import Trial, is_finished, run_trial
from laneweave.protocol.errors import CommandFailedError

OPTIONS = ("--transport", "simulated", "--volume", "900", "--duration", "5")


@pytest.mark.slow
def test_a_run_counts_if_its_status_is_the_expected_one(tmp_path: Path) -> None:
    """The second run is complete, but its breakdown did not happen, so its status is 1."""
    faults = tmp_path / "faults.toml"
    faults.write_text("[[breakdown]]\nat_s = 500\n", encoding="utf-8")
    good = Trial("length", "good", OPTIONS)
    bad = Trial("length", "bad", (*OPTIONS, "--faults", str(faults)))

    run_trial(good, tmp_path, tmp_path, lambda: False)
    assert is_finished(good, tmp_path)
    with pytest.raises(CommandFailedError, match=r"status 1: .* 0 of 1 vehicles"):
        run_trial(bad, tmp_path, tmp_path, lambda: False)
    assert not is_finished(bad, tmp_path)
