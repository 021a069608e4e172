"""The agent process: one vehicle, or several, over Zenoh."""

from __future__ import annotations

from collections.abc import Iterable

from laneweave.agents.core import AgentCore
from laneweave.agents.host import AgentHost, Shard
from laneweave.protocol.faulty_core import Wrap, bare
from laneweave.protocol.incarnations import Incarnations
from laneweave.protocol.messages import Name
from laneweave.protocol.scenario import Scenario
from laneweave.protocol.zenoh_transport import run_core


def run_agents(
    scenario: Scenario,
    vehicles: Iterable[str],
    shard: Shard | None = None,
    wrap: Wrap = bare,
) -> None:
    """Run agents until their vehicles have left the road, or until SIGINT or SIGTERM.

    `wrap` may put faults before them.

    Raises:
        BadInputError: nobody answers at the scenario's endpoint.
    """
    incarnations = Incarnations()
    host = AgentHost(
        lambda vehicle: AgentCore(vehicle, incarnations, scenario),
        [Name(vehicle) for vehicle in vehicles],
        shard,
    )
    network = scenario.network
    run_core(wrap(host), network.endpoint, network.realm, network.lease_s)
