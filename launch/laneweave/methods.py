"""Interface of reference methods that users add; docs/OWN_METHOD.md explains it.

A method is a `ReferenceMethod`, named by an entry point of the group `laneweave.methods`. Then
`laneweave run --method NAME` and `laneweave sweep --methods NAME,rule` use it. There are three ways
to write one, the shortest first:

- a subclass of `RuleMethod` with other `Rules`: when vehicles change lanes, their speeds;
- SUMO drives, with other commands or parameters: see `Lc2013Traffic`;
- a `Traffic` of one's own.
"""

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.lc2013 import Lc2013Method, Lc2013Traffic
from laneweave.sim_bridge.baselines.reference_method import ReferenceMethod
from laneweave.sim_bridge.baselines.reference_road import Entrance, ReferenceVehicle, Traffic
from laneweave.sim_bridge.baselines.rule_based import RuleMethod, RuleTraffic
from laneweave.sim_bridge.baselines.rules import Following, Lanes, Rules, priority
from laneweave.sim_bridge.baselines.wanted_lanes import WantedLanes
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.sumo.sumo_world import SumoWorld
from laneweave.sim_bridge.sumo.traffic import SumoTraffic

__all__ = (
    "Arrival",
    "BadInputError",
    "Entrance",
    "Following",
    "Lanes",
    "Lc2013Method",
    "Lc2013Traffic",
    "Pose",
    "ReferenceMethod",
    "ReferenceVehicle",
    "RuleMethod",
    "RuleTraffic",
    "Rules",
    "Scenario",
    "SumoTraffic",
    "SumoWorld",
    "Traffic",
    "WantedLanes",
    "priority",
)
