"""Profiles: kinds and severity of the faults in the runs of a search.

A profile has the ranges or choices from which each seed draws. Shares are probabilities, times are
in virtual seconds.
"""

from __future__ import annotations

from attrs import evolve, frozen

from laneweave.protocol.errors import BadInputError

Span = tuple[int, int]
"""Minimum and maximum, both included."""

COORDINATOR_HARM = ("leader-kill", "leader-pause", "coordinator-kill", "coordinator-pause")
AGENT_HARM = ("agent-kill", "agent-kill", "agent-pause", "agent-twin")
NETWORK_HARM = ("cut", "partition", "partition", "blackout", "router-loss")
NOISE = ("garbage", "replay")


@frozen(kw_only=True)
class Profile:
    """The ranges and choices from which the seeds of a search draw."""

    name: str
    text: str
    """Purpose in one line."""
    rolling: bool = False
    """Use the rolling operation: vehicles own cells and are planned as one stream."""
    density: tuple[float, float] = (0.3, 0.7)
    """Share of the cells of a stretch in which vehicles enter (rolling operation)."""
    vehicles: Span = (2, 16)
    blocks: Span = (1, 4)
    lanes: Span = (2, 4)
    growing: float = 0.5
    """Share of runs in which formations have different lengths."""
    max_joined: Span = (1, 2)
    crowding: float = 0.5
    """Share of runs in which more vehicles may prefer a lane of a block than it has cells."""
    leavers: float = 0.15
    """Share of vehicles that leave the road during the fault phase."""
    loss: tuple[float, ...] = (0.0, 0.0, 0.1, 0.3, 0.5, 0.8)
    """Probability that a receiver does not get a message."""
    duplication: tuple[float, ...] = (0.0, 0.0, 0.3)
    jitter_s: tuple[float, ...] = (0.003, 0.003, 0.003, 0.05, 0.05, 0.3, 0.3, 1.0, 5.0)
    """Maximum delay of a message; the minimum is 2 ms."""
    command_loss: tuple[float, ...] = (0.0, 0.0, 0.0, 0.3)
    """Additional loss of SENSE and COMMAND messages."""
    slow_moves: tuple[float, ...] = (0.0, 0.2, 0.5)
    """Share of motions that take up to three slots."""
    compute_failure: tuple[float, ...] = (0.0, 0.0, 0.0, 0.3)
    compute_jitter_s: tuple[float, ...] = (0.0, 0.0, 0.3, 2.0)
    """Maximum additional planning time."""
    wrong_clocks: float = 0.7
    """Share of runs with wrong clocks: offsets up to 50 ms, rate errors up to 5 %."""
    harm: tuple[str, ...] = COORDINATOR_HARM + AGENT_HARM + NETWORK_HARM + NOISE
    """Kinds of fault events, equally likely; see `faults`."""
    events: Span = (0, 12)
    """Number of fault events in a run."""
    fault_s: tuple[float, float] = (10.0, 12.0)
    """Length of the fault phase, after which all vehicles must arrive."""


_MIXED = Profile(name="mixed", text="all kinds of faults in all combinations")
_CALM = Profile(
    name="calm",
    text="no faults: what a run looks like",
    loss=(0.0,),
    duplication=(0.0,),
    jitter_s=(0.003,),
    command_loss=(0.0,),
    slow_moves=(0.0,),
    compute_failure=(0.0,),
    compute_jitter_s=(0.0,),
    wrong_clocks=0.0,
    harm=(),
    events=(0, 0),
)

_ALL = (
    _MIXED,
    _CALM,
    evolve(
        _CALM,
        name="loss",
        text="messages are lost (sometimes all), duplicated, delayed and reordered",
        loss=(0.3, 0.5, 0.8, 0.9),
        duplication=(0.0, 0.3),
        jitter_s=(0.003, 0.3, 5.0),
        command_loss=(0.0, 0.3),
        harm=("blackout", "replay"),
        events=(0, 6),
    ),
    evolve(
        _CALM,
        name="coordinators",
        text="coordinators are killed, restarted, paused and resumed; planning fails",
        loss=(0.0, 0.2),
        jitter_s=(0.003, 0.3),
        compute_failure=(0.0, 0.3),
        compute_jitter_s=(0.0, 2.0),
        harm=COORDINATOR_HARM,
        events=(4, 14),
    ),
    evolve(
        _CALM,
        name="agents",
        text="agents are killed, sometimes restarted, paused and resumed; motions are slow",
        loss=(0.0, 0.2),
        jitter_s=(0.003, 0.3),
        command_loss=(0.0, 0.3),
        slow_moves=(0.0, 0.5),
        harm=(*AGENT_HARM, "cut"),
        events=(4, 14),
    ),
    evolve(
        _CALM,
        name="partitions",
        text="separated groups, disconnected nodes, loss of the router",
        loss=(0.0, 0.3),
        jitter_s=(0.003, 0.3),
        harm=NETWORK_HARM,
        events=(3, 12),
    ),
    evolve(
        _MIXED,
        name="clocks",
        text="every clock has a wrong offset and rate",
        wrong_clocks=1.0,
        events=(0, 4),
    ),
    evolve(
        _MIXED,
        name="joint",
        text="two neighbouring formations with lanes too short for one: joint ballots",
        vehicles=(6, 9),
        blocks=(2, 2),
        lanes=(3, 4),
        max_joined=(2, 2),
        crowding=1.0,
        events=(0, 8),
    ),
    evolve(
        _MIXED,
        name="dense",
        text="twelve vehicles in few blocks; also a measure of simulation speed",
        vehicles=(12, 12),
        blocks=(2, 2),
        lanes=(4, 4),
        growing=0.0,
        max_joined=(1, 1),
    ),
    evolve(
        _MIXED,
        name="rolling",
        text="the rolling operation, in which vehicles transfer cells, with all kinds of faults",
        rolling=True,
        vehicles=(3, 14),
        fault_s=(9.0, 14.0),
    ),
    evolve(
        _MIXED,
        name="rolling-dense",
        text="the rolling operation with up to nine of ten cells occupied",
        rolling=True,
        vehicles=(8, 18),
        density=(0.6, 0.9),
        fault_s=(9.0, 14.0),
        events=(0, 6),
    ),
)
PROFILES = {profile.name: profile for profile in _ALL}


def profile_named(name: str) -> Profile:
    """Return the profile of a name.

    Raises:
        BadInputError: there is no such profile.
    """
    if name not in PROFILES:
        raise BadInputError("--profile", name, ", ".join(PROFILES))
    return PROFILES[name]
