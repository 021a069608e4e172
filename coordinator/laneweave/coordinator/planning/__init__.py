"""Target assignment and path planning in the relative coordinate system.

`plan` answers one `PlanRequest`. Where the paper's parts are:

| paper | module |
|---|---|
| relative motion modes 1 and 2 | `grid` |
| conflict model | `conflicts` |
| formation relative distance, cost matrix C | `frd` |
| preference matrix P | `preference` |
| assignments in non-decreasing order of cost | `assignments` |
| TAPPA, Algorithm 1 | `tappa` |
| CBSA, Algorithm 2 | `cbs` |
| conflicts and constraints of the tree | `constraints` |
| SPPA | `diagram` (all shortest paths), `sppa` (the choice among them) |
| relative path map | `path_map` |
| parallel and interlaced structure | `structures` |

Beyond the paper: what makes TAPPA fast, with a switch for each (`improvements`, `splits`, `joint`);
what it did (`explanation`); branch and bound, the fallback of TAPPA (`branching`, `relaxation`,
`rows`); path sets by negotiation (`negotiation`, `repair`) and by joint search (`reachability`);
conflicts computed from sizes and motions (`geometry`, `bodies`, `clearances`).

The package is pure: no I/O, no state between calls, and time only through the clock it is given.
"""

from laneweave.coordinator.planning.facade import checked_plan, plan, warm_up
from laneweave.coordinator.planning.frd import Weights
from laneweave.coordinator.planning.geometry.settings import Geometry
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.validator import problems_of_paths, problems_of_response

__all__ = [
    "Geometry",
    "PlanRequest",
    "PlanResponse",
    "VehicleRequest",
    "Weights",
    "checked_plan",
    "plan",
    "problems_of_paths",
    "problems_of_response",
    "warm_up",
]
