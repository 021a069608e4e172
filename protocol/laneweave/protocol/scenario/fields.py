"""The scenario: one TOML file for world and deployment, read by every role.

Every field has its unit in its name, a checked range, and a default: the paper's value (Table
"Simulation parameters") if there is one. `config` reads the file and checks the rules between
fields. What follows from the fields is computed in `road_geometry`, `timing`, `vehicle_types` and
`traffic_flow`, and reached by the properties of `Scenario`.
"""

from __future__ import annotations

from functools import cached_property

from attrs import field, frozen

from laneweave.protocol.field_validators import one_of, within
from laneweave.protocol.lattice import Lattice
from laneweave.protocol.scenario.deployment_fields import (
    Network,
    Observation,
    Runtime,
    Security,
    Service,
    SumoSettings,
)
from laneweave.protocol.scenario.formation_table import FormationSettings
from laneweave.protocol.scenario.radio_table import Radio
from laneweave.protocol.scenario.road_geometry import RoadGeometry
from laneweave.protocol.scenario.road_tables import Demand, Entrance, Exit, Road, TypeShare
from laneweave.protocol.scenario.timing import Timing
from laneweave.protocol.scenario.traffic_flow import TrafficFlow
from laneweave.protocol.scenario.vehicle_tables import (
    Braking,
    Lc2013Settings,
    RuleSettings,
    Sensing,
    Tracking,
    Vehicle,
    VehicleTypeSettings,
)
from laneweave.protocol.scenario.vehicle_types import VehicleTypes

SCHEMA = "laneweave.scenario/1"


@frozen(cache_hash=True)  # it is a key of caches
class Scenario:
    """Complete configuration, read by all roles."""

    schema: str = field(default=SCHEMA, validator=one_of(SCHEMA))
    seed: int = field(default=1, validator=within(0, 2**63 - 1))
    road: Road = Road()
    entrance: tuple[Entrance, ...] = ()
    """Entrances other than the start of the road."""
    exit: tuple[Exit, ...] = ()
    """Exits other than the end of the road."""
    demand: Demand = Demand()
    formation: FormationSettings = FormationSettings()
    vehicle: Vehicle = Vehicle()
    vehicle_type: tuple[VehicleTypeSettings, ...] = ()
    """Types of vehicles other than cars."""
    sensing: Sensing = Sensing()
    braking: Braking = Braking()
    tracking: Tracking = Tracking()
    rule: RuleSettings = RuleSettings()
    lc2013: Lc2013Settings = Lc2013Settings()
    network: Network = Network()
    radio: Radio = Radio()
    runtime: Runtime = Runtime()
    security: Security = Security()
    service: Service = Service()
    observation: Observation = Observation()
    sumo: SumoSettings = SumoSettings()

    @cached_property
    def lattice(self) -> Lattice:
        """The lattice of this scenario."""
        return Lattice(
            pitch_m=self.formation.gap_m,
            speed_mps=self.formation.speed_mps,
            lane_width_m=self.road.lane_width_m,
            lanes=self.road.lanes,
            block_columns=self.formation.block_width,
        )

    @cached_property
    def geometry(self) -> RoadGeometry:
        """Where lanes are open, and where vehicles enter, leave and change lanes."""
        return RoadGeometry(self.road, self.entrance, self.exit, self.formation)

    @cached_property
    def timing(self) -> Timing:
        """Slots, durations of moves, the tracker's horizon."""
        return Timing(
            self.formation,
            self.vehicle,
            self.demand.volume_veh_per_lane_h,
            self.geometry.sections,
            self.road.length_m,
            self.runtime.tick_s,
            self.tracking.horizon_ticks,
        )

    @cached_property
    def types(self) -> VehicleTypes:
        """The types of vehicles by name, cars first."""
        cycle_s = self.timing.cycles_s[0]
        return VehicleTypes(self.vehicle, self.vehicle_type, self.formation, cycle_s)

    @cached_property
    def flow(self) -> TrafficFlow:
        """Which vehicles enter in which lane, and what formations can carry."""
        return TrafficFlow(
            self.road,
            self.demand,
            self.entrance,
            self.formation,
            tuple(TypeShare(one.name, one.share) for one in self.vehicle_type),
            self.geometry.entry_points,
            drawn=not self.sumo.config,
        )
