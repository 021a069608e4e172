"""Checks of the deployment: periods of processes, a corridor of SUMO, access control."""

from __future__ import annotations

from itertools import chain

from attrs import evolve

from laneweave.protocol.config.participants import (
    demanded_vehicles,
    identities_of,
    max_vehicles,
)
from laneweave.protocol.config.rules import compare, require
from laneweave.protocol.errors import BadInputError, raise_all
from laneweave.protocol.field_validators import host_of, is_encrypted
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.radio_table import C_V2X, DSRC, Radio
from laneweave.protocol.wire.identities import MAX_COMMON_NAME

MAX_SECURED_VEHICLES = 5000
"""Maximum number of vehicles for which a router holds access rules."""


def check_periods(scenario: Scenario) -> None:
    """Check the periods and timeouts of processes."""
    heartbeat_s, silent_s = scenario.network.heartbeat_s, scenario.runtime.agent_silent_s
    deadline_s = scenario.runtime.tick_deadline_s
    what = "runtime.agent_silent_s, so a lost session is detected before its agent counts as silent"
    compare(
        scenario,
        [
            ("network.election_s", "more than", 2 * heartbeat_s, "twice network.heartbeat_s"),
            ("network.lease_s", "more than", heartbeat_s, "network.heartbeat_s"),
            ("runtime.tick_resend_s", "less than", deadline_s, "runtime.tick_deadline_s"),
            ("runtime.tick_deadline_s", "at most", silent_s, "runtime.agent_silent_s"),
            ("network.lease_s", "at most", silent_s, what),
        ],
    )


def check_radio(scenario: Scenario) -> None:
    """Check that a radio is named if values of it are given."""
    radio = scenario.radio
    named = evolve(radio, technology=C_V2X) == Radio(technology=C_V2X)
    allowed = f'"{C_V2X}" or "{DSRC}" with other values of the table'
    require(radio.enabled or named, "radio.technology", radio.technology, allowed)


def check_sumo(scenario: Scenario) -> None:
    """Check that a corridor of a SUMO simulation is named, and driven by the operation for it."""
    sumo = scenario.sumo
    first, _, last = sumo.corridor.partition(":")
    if not sumo.config:
        require(not sumo.corridor, "sumo.corridor", sumo.corridor, "none without sumo.config")
        return
    allowed = "FIRST_EDGE:LAST_EDGE, two edges of the network of sumo.config"
    require(bool(first and last), "sumo.corridor", sumo.corridor, allowed)
    formation = scenario.formation
    allowed = '"rolling" with sumo.config'
    ok = "sumo.config" not in formation.traits.unused
    require(ok, "formation.operation", formation.operation, allowed)
    allowed = "false with sumo.config: vehicles from SUMO settle in columns of their own"
    require(not formation.change_columns, "formation.change_columns", True, allowed)


def _check_fleet_names(scenario: Scenario) -> None:
    """Check that no fleet has the name of a vehicle: it could read messages to that vehicle."""
    security = scenario.security
    listed = (members for members in security.fleets.values() if not isinstance(members, str))
    vehicles = {*security.vehicles, *demanded_vehicles(scenario), *chain.from_iterable(listed)}
    raise_all(
        BadInputError(f"security.fleets[{name}]", name, "a name that no vehicle has")
        for name in security.fleets
        if name in vehicles
    )


def check_security(scenario: Scenario) -> None:
    """Check that endpoints suit access control."""
    network, security = scenario.network, scenario.security
    secured = security.mode == "mtls"
    endpoints = [("network.endpoint", network.endpoint)] if network.endpoint else []
    endpoints += [("network.listen", endpoint) for endpoint in network.listen]
    if secured:
        allowed = "tls/HOST:PORT or quic/HOST:PORT, as security.mode is mtls"
        raise_all(
            BadInputError(name, endpoint, allowed)
            for name, endpoint in endpoints
            if not is_encrypted(endpoint)
        )
    for name, endpoint in endpoints:
        allowed = f"mtls, as {name} is {endpoint}"
        require(secured or not is_encrypted(endpoint), "security.mode", "off", allowed)
    if not secured:
        return
    # Zenoh 1.10 cannot connect to such an address, although it can listen there.
    allowed = "a name or an IPv4 address with TLS and QUIC"
    is_ipv6 = ":" in host_of(network.endpoint)
    require(not is_ipv6, "network.endpoint", network.endpoint, allowed)
    require(bool(security.folder), "security.folder", "", "the folder of the certificates")


def check_secured_demand(scenario: Scenario) -> None:
    """Check fleets and the number of vehicles under access control; the demand must be valid."""
    if scenario.security.mode != "mtls":
        return
    _check_fleet_names(scenario)
    count = max_vehicles(scenario)
    require(
        count <= MAX_SECURED_VEHICLES,
        "demand.duration_s",
        scenario.demand.duration_s,
        f"a demand of at most {MAX_SECURED_VEHICLES} vehicles (now up to {count}) where "
        "security.mode is mtls: the router has rules for each vehicle",
    )
    for identity in identities_of(scenario):
        name = identity.common_name
        require(
            len(name) <= MAX_COMMON_NAME,
            f"security.{identity.party}s",
            name,
            f"at most {MAX_COMMON_NAME} characters: it is the common name of a certificate",
        )
