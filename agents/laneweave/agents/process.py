"""The process that runs one or more agents over Zenoh."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

from laneweave.agents.core import AgentCore
from laneweave.agents.driving.driver import TrackingDriver
from laneweave.agents.host import AgentHost
from laneweave.protocol.lattice import displacements
from laneweave.protocol.radio.radio_core import over_radio
from laneweave.protocol.runtime.message_faults import CoreWrapper, unwrapped
from laneweave.protocol.runtime.metrics import Observe, unobserved
from laneweave.protocol.runtime.settings_check import CheckedCore, Process
from laneweave.protocol.scenario.common_settings import settings_of
from laneweave.protocol.scenario.deployment_fields import Shard
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.runner import run_core
from laneweave.protocol.vehicle.motion import cell_state
from laneweave.protocol.wire.identities import Incarnations, parse_identity
from laneweave.protocol.wire.messages import CurrentMotion, Name, Sense, VehicleRecord
from laneweave.protocol.wire.topics import SENSE, Party


def warm_up(scenario: Scenario) -> None:
    """Plan every move and drive one tick, to fill the caches that forked processes inherit."""
    driver = TrackingDriver(scenario, scenario.vehicle)
    column, lane = cell = (0, 1)
    moves = displacements(scenario.formation.mode)[1:]
    for ticks, (dx, dy) in product(scenario.timing.move_durations, moves):
        driver.begin((0, cell, (column + dx, lane + dy)), 0, ticks)
    sense = Sense(
        vehicle=Name("warm-up"),
        tick=0,
        t_s=0.0,
        measured=cell_state(scenario.lattice, cell, 0.0),
        hold_cell=cell,
        motion=CurrentMotion(cell),
        preferred_lane=lane,
        record=VehicleRecord(),
        ahead=(),
    )
    driver.drive(sense, moving=True)


def run_agents(
    scenario: Scenario,
    access: Access,
    vehicles: Iterable[str],
    shard: Shard | None = None,
    wrap: CoreWrapper = unwrapped,
    observe: Observe = unobserved,
) -> None:
    """Run agents until their vehicles have left the road, or until SIGINT or SIGTERM.

    Args:
        scenario: settings that all vehicles share.
        access: endpoint, realm and identity of this process.
        vehicles: names of the vehicles; empty with a shard.
        shard: share of the announced vehicles; see `AgentHost`.
        wrap: wraps the core, to inject faults.
        observe: registers the metrics source.

    Raises:
        BadInputError: no router answers at the endpoint.
    """
    incarnations = Incarnations()
    incarnation = incarnations()
    names = [Name(vehicle) for vehicle in vehicles]
    drives = "named" if shard is None else shard.name
    process = Process.of(parse_identity(access.identity), incarnation, drives)
    host = AgentHost(
        process.name,
        lambda vehicle: AgentCore(vehicle, incarnations, scenario),
        incarnation,
        scenario.runtime,
        names,
        shard,
    )
    settings = settings_of(scenario)
    received = over_radio(host, scenario, Party.VEHICLE, process.name, host.listeners)
    core = CheckedCore(received, process, settings, SENSE)
    run_core(wrap(core), access, observe=observe)
