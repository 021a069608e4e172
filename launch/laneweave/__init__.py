"""Formation control with lane preference for connected and automated vehicles.

    import laneweave

    summary = laneweave.run("scenarios/demo.toml", transport="simulated", out="runs/first")
    recorded = laneweave.load_run("runs/first")
    trajectories = recorded.trajectories().to_pandas()

Names are imported when they are first used: `import laneweave` by itself loads nothing.
"""

from importlib import import_module
from pkgutil import extend_path
from typing import TYPE_CHECKING

# In an editable install, the packages of the four other folders belong to this package, too. The
# order is that of `sys.path`, whichever folder this file is in. `__spec__` has the same list.
__path__[:] = extend_path([], __name__)

if TYPE_CHECKING:
    from laneweave.coordinator.planning.request import PlanRequest
    from laneweave.coordinator.planning.response import PlanResponse
    from laneweave.coordinator.service.client import PlanClient, PlanError
    from laneweave.launch.explain.explanation import Explanation
    from laneweave.launch.library.plans import plan
    from laneweave.launch.library.recorded_run import RecordedRun, load_run
    from laneweave.launch.library.runs import RunFailedError, load_scenario, run
    from laneweave.protocol.errors import BadInputError
    from laneweave.protocol.scenario.fields import Scenario
    from laneweave.protocol.summary import RunSummary

    __version__: str

__all__ = (
    "BadInputError",
    "Explanation",
    "PlanClient",
    "PlanError",
    "PlanRequest",
    "PlanResponse",
    "RecordedRun",
    "RunFailedError",
    "RunSummary",
    "Scenario",
    "__version__",
    "load_run",
    "load_scenario",
    "plan",
    "run",
)

_MODULES = {
    "BadInputError": "laneweave.protocol.errors",
    "Explanation": "laneweave.launch.explain.explanation",
    "PlanClient": "laneweave.coordinator.service.client",
    "PlanError": "laneweave.coordinator.service.client",
    "PlanRequest": "laneweave.coordinator.planning.request",
    "PlanResponse": "laneweave.coordinator.planning.response",
    "RecordedRun": "laneweave.launch.library.recorded_run",
    "RunFailedError": "laneweave.launch.library.runs",
    "RunSummary": "laneweave.protocol.summary",
    "Scenario": "laneweave.protocol.scenario.fields",
    "load_run": "laneweave.launch.library.recorded_run",
    "load_scenario": "laneweave.launch.library.runs",
    "plan": "laneweave.launch.library.plans",
    "run": "laneweave.launch.library.runs",
}
"""Module of each public name."""


def __getattr__(name: str) -> object:
    """Import a public name when it is first used (PEP 562)."""
    if name == "__version__":
        value: object = import_module("importlib.metadata").version("laneweave")
    elif name in _MODULES:
        value = getattr(import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, and the subpackages that have been imported."""
    return sorted({*globals(), *__all__})
