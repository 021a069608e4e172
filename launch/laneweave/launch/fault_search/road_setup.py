"""The road of a run, and its scenario.

In the rolling operation the road is short, because plans extend to its end.
"""

from __future__ import annotations

import random

from attrs import evolve, frozen

from laneweave.launch.fault_search.events.lasting_faults import LEASE_S
from laneweave.launch.fault_search.road.drawn_roads import STRAIGHT_ROAD, DrawnRoad
from laneweave.launch.fault_search.road.drawn_surprises import NO_SURPRISES, Surprises
from laneweave.protocol.scenario.deployment_fields import Network, Runtime
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import FormationSettings
from laneweave.protocol.scenario.road_tables import Road
from laneweave.protocol.scenario.vehicle_tables import VehicleTypeSettings

TICK_S = 0.1

# Operation in formations
SLOT_S, MOVE_S = 1.0, 0.8
MODES = (1, 1, 2)
BLOCK_COLUMNS = 4
MAX_SIZE = 6
"""Maximum number of vehicles in a formation."""

# Rolling operation
SLOTS_S = (1.0, 1.0, 1.0, 2.0)
"""Slot lengths to draw from. Ballots often abort with the shortest."""
MOVE_SHARE = 0.8
"""Duration of a move as a share of the slot."""
SLOTS_ON_ROAD = 45
"""Length of the road, as the number of slots that a column takes to pass it."""
TRUCK = VehicleTypeSettings("truck", 0.3, max_accel_mps2=4.0)
"""A type that cannot change columns in the short slots of the fault search. It has the size of
cars, since sizes and brakes do not matter to light bodies."""
HOLD_PERIODS_TICKS = (1, 5)
"""Values of `runtime.hold_period_ticks` to draw from."""
STREAM_PLANNER = 0.05
"""Share of runs with the stream planner, which takes ten times as long as the rest of a run."""


@frozen(kw_only=True)
class RoadSetup:
    """Road and operation of a run."""

    lanes: int
    rolling: bool = False
    roadside: bool = False
    """Whether vehicles enter at the real roadside."""
    growing: bool = False
    """Whether formations have different lengths."""
    max_joined: int = 1
    max_vehicles: int = MAX_SIZE
    """Maximum number of vehicles in a formation at the real roadside."""
    slot_s: float = SLOT_S
    move_s: float = MOVE_S
    mode: int = 1
    before_m: float = 0.0
    """Length of the road before S3."""
    seed: int = 0
    stream_planner: bool = False
    """Whether the stream planner replaces `LightPlanner` (rolling operation)."""
    trucks: bool = False
    """Whether there are vehicles that do not change columns (at the roadside)."""
    drawn: DrawnRoad = STRAIGHT_ROAD
    """Closed parts, ramps and exits (at the real roadside)."""
    surprises: Surprises = NO_SURPRISES
    hold_period_ticks: int = 1
    """Ticks between two messages of a vehicle that holds undisturbed; 1, as in older stories: all
    get SENSE in every tick."""

    def make_scenario(self) -> Scenario:
        """Return the scenario of the road."""
        if self.rolling:
            formation = FormationSettings(
                operation="rolling",
                cycle_s=self.slot_s,
                move_s=self.move_s,
                mode=self.mode,
                sort_in_s2=False,
                change_columns=not self.drawn.keeps_columns,
            )
            s3_m = SLOTS_ON_ROAD * self.slot_s * formation.speed_mps
        else:
            formation = FormationSettings(
                operation="formations",
                close="vehicles" if self.growing else "columns",
                block_columns=BLOCK_COLUMNS,
                max_vehicles=self.max_vehicles,
                cycle_s=self.slot_s,
                move_s=self.move_s,
                max_joined=self.max_joined,
                mode=self.mode,
                # Limit planning by nodes: a deadline would make plans depend on the machine.
                planning_deadline_s=3600.0,
                max_nodes=500,
            )
            s3_m = 20_000.0
        drawn = self.drawn
        return Scenario(
            road=Road(
                self.lanes,
                s1_m=0.0,
                s2_m=self.before_m,
                s3_m=s3_m,
                closures=drawn.closures,
                events=self.surprises.events,
            ),
            entrance=drawn.entrance,
            exit=drawn.exit,
            vehicle_type=(TRUCK,) if self.trucks else (),
            formation=formation,
            network=Network(heartbeat_s=0.2, election_s=0.6, lease_s=LEASE_S),
            runtime=Runtime(
                tick_s=TICK_S, agent_silent_s=1.5, hold_period_ticks=self.hold_period_ticks
            ),
            seed=self.seed,
        )


def draw_rolling_road(lanes: int, rng: random.Random, before_columns: int = 0) -> RoadSetup:
    """Draw a road of the rolling operation; with columns before S3, it has a roadside."""
    slot_s = rng.choice(SLOTS_S)
    road = RoadSetup(
        lanes=lanes,
        rolling=True,
        roadside=before_columns > 0,
        slot_s=slot_s,
        move_s=round(MOVE_SHARE * slot_s / TICK_S) * TICK_S,
        mode=rng.choice(MODES),
        seed=rng.randrange(2**31),
        stream_planner=rng.random() < STREAM_PLANNER,
    )
    return evolve(road, before_m=before_columns * road.make_scenario().lattice.pitch_m)


def own_rng(road: RoadSetup, purpose: str) -> random.Random:
    """Return a random generator for one purpose alone: no other draw depends on it."""
    return random.Random(f"types/{purpose}/{road.seed}")  # noqa: S311 (simulation, no secrets)
