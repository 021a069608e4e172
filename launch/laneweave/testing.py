"""A pytest plug-in for tests of scenarios and faults; docs/FAULTS.md has a guide.

pytest loads it in every environment in which laneweave is installed.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import pytest

if TYPE_CHECKING:
    from laneweave.launch.faults.fault_file import FaultSource
    from laneweave.launch.library.runs import ScenarioSource, Transport
    from laneweave.protocol.summary import RunSummary


class BrokenRunError(AssertionError):
    """A run has failed or broken a promise; the message has all problems, and its folder."""

    def __init__(self, problems: Sequence[str], folder: Path) -> None:
        """Store the folder of the run and what is wrong with it."""
        super().__init__("\n".join([*problems, f"files of the run: {folder}"]))
        self.problems = tuple(problems)
        self.folder = folder

    def __reduce__(self) -> tuple[type[BrokenRunError], tuple[tuple[str, ...], Path]]:
        """Return how to copy the error to another process."""
        return BrokenRunError, (self.problems, self.folder)


class LaneweaveRun(Protocol):
    """Runs a scenario; the test fails if the run does, or breaks a promise."""

    def __call__(
        self,
        scenario: ScenarioSource = None,
        *,
        faults: FaultSource = None,
        method: str = "formation",
        transport: Transport | None = None,
        **overrides: Any,  # noqa: ANN401 (any field of a scenario)
    ) -> RunSummary:
        """Return the summary of the run; `summary.folder` has its files.

        Args:
            scenario: as in `laneweave.run`.
            faults: as in `laneweave.run`.
            method: as in `laneweave.run`.
            transport: as in `laneweave.run`, but by default in virtual time.
            **overrides: as in `laneweave.run`.

        Raises:
            BadInputError: an argument or a value of the scenario is invalid.
            BrokenRunError: the run has failed or broken a promise.
        """


@pytest.fixture
def laneweave_run(tmp_path: Path) -> LaneweaveRun:
    """Return a function that runs a scenario, with faults, in a folder of the test."""
    # Other tests in an environment with laneweave need not wait for this.
    from laneweave.launch.library.runs import RunFailedError, run
    from laneweave.protocol.errors import BadInputError

    numbers = count(1)

    def run_scenario(
        scenario: ScenarioSource = None,
        *,
        faults: FaultSource = None,
        method: str = "formation",
        transport: Transport | None = None,
        **overrides: Any,  # noqa: ANN401 (any field of a scenario)
    ) -> RunSummary:
        __tracebackhide__ = True
        if "out" in overrides:
            allowed = "nothing: each run has a folder of the test, `summary.folder`"
            raise BadInputError("out", overrides["out"], allowed)
        out = tmp_path / f"run-{next(numbers)}"
        if transport is None and method == "formation":
            transport = "simulated"
        try:
            return run(
                scenario,
                out=out,
                method=method,
                transport=transport,
                faults=faults,
                **overrides,
            )
        except BadInputError as error:
            # pytest shows the line of the test instead of frames of the library, and all errors.
            for problem in error.problems[1:]:
                error.add_note(str(problem))
            raise error.with_traceback(None) from None
        except RunFailedError as error:
            problems = error.problems
        raise BrokenRunError(problems, out)

    return run_scenario
