"""Profiles: how hard the runs of a search are, and on what they lay stress.

A profile gives the range or the choices from which each seed draws. Shares are probabilities, times
virtual seconds.
"""

from __future__ import annotations

from attrs import evolve, frozen

from laneweave.protocol.errors import BadInputError

Span = tuple[int, int]
"""Least and greatest, both included."""

COORDINATOR_HARM = ("leader-kill", "leader-pause", "coordinator-kill", "coordinator-pause")
AGENT_HARM = ("agent-kill", "agent-kill", "agent-pause", "agent-twin")
NETWORK_HARM = ("cut", "partition", "partition", "blackout", "router-loss")
NOISE = ("garbage", "replay")


@frozen(kw_only=True)
class Profile:
    """What the seeds of a search draw from."""

    name: str
    text: str
    """What it is for, in one line."""
    rolling: bool = False
    """Vehicles own cells and are planned as one stream, not in formations."""
    density: tuple[float, float] = (0.3, 0.7)
    """Share of the cells of a stretch that vehicles enter in (rolling operation)."""
    vehicles: Span = (2, 16)
    blocks: Span = (1, 4)
    lanes: Span = (2, 4)
    growing: float = 0.5
    """Share of runs in which formations have different lengths."""
    max_joined: Span = (1, 2)
    crowding: float = 0.5
    """Share of runs in which more vehicles may want a lane of a block than it has cells."""
    leavers: float = 0.15
    """Share of vehicles that leave the road while faults happen."""
    loss: tuple[float, ...] = (0.0, 0.0, 0.1, 0.3, 0.5, 0.8)
    """Share of messages that do not reach a receiver."""
    duplication: tuple[float, ...] = (0.0, 0.0, 0.3)
    jitter_s: tuple[float, ...] = (0.003, 0.003, 0.003, 0.05, 0.05, 0.3, 0.3, 1.0, 5.0)
    """Greatest delay of a message; the least is 2 ms."""
    command_loss: tuple[float, ...] = (0.0, 0.0, 0.0, 0.3)
    """Share of SENSE and COMMAND messages that are lost beside."""
    slow_moves: tuple[float, ...] = (0.0, 0.2, 0.5)
    """Share of motions that take up to three slots."""
    compute_failure: tuple[float, ...] = (0.0, 0.0, 0.0, 0.3)
    compute_jitter_s: tuple[float, ...] = (0.0, 0.0, 0.3, 2.0)
    """Planning takes up to this much longer."""
    wrong_clocks: float = 0.7
    """Share of runs in which every clock is wrong: by up to 50 ms, its rate by up to 5 %."""
    harm: tuple[str, ...] = COORDINATOR_HARM + AGENT_HARM + NETWORK_HARM + NOISE
    """Kinds of single events, each as likely as the others; `faults` does them."""
    events: Span = (0, 12)
    """Single events in a run."""
    fault_s: tuple[float, float] = (10.0, 12.0)
    """How long faults happen; then everything is whole and everybody must arrive."""


_MIXED = Profile(name="mixed", text="everything that can go wrong, in every mixture")
_CALM = Profile(
    name="calm",
    text="no faults at all: what a run looks like",
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
        text="messages are lost (also all of them), doubled, delayed and overtaken",
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
        text="coordinators are killed, restarted, paused and woken as zombies; plannings fail",
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
        text="agents are killed, restarted or not, paused and woken; motions are slow",
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
        text="groups that do not hear each other, nodes cut off, the router lost",
        loss=(0.0, 0.3),
        jitter_s=(0.003, 0.3),
        harm=NETWORK_HARM,
        events=(3, 12),
    ),
    evolve(
        _MIXED,
        name="clocks",
        text="every clock is wrong, in offset and rate",
        wrong_clocks=1.0,
        events=(0, 4),
    ),
    evolve(
        _MIXED,
        name="joint",
        text="two neighbouring formations, lanes too small for one: joint ballots",
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
        text="twelve vehicles in few blocks, for the speed of the simulation, too",
        vehicles=(12, 12),
        blocks=(2, 2),
        lanes=(4, 4),
        growing=0.0,
        max_joined=(1, 1),
    ),
    evolve(
        _MIXED,
        name="rolling",
        text="the rolling operation: vehicles own cells, which change hands; everything goes wrong",
        rolling=True,
        vehicles=(3, 14),
        fault_s=(9.0, 14.0),
    ),
    evolve(
        _MIXED,
        name="rolling-dense",
        text="the same with up to nine of ten cells taken",
        rolling=True,
        vehicles=(8, 18),
        density=(0.6, 0.9),
        fault_s=(9.0, 14.0),
        events=(0, 6),
    ),
)
PROFILES = {profile.name: profile for profile in _ALL}


def profile_named(name: str) -> Profile:
    """Return a profile.

    Raises:
        BadInputError: there is none of this name.
    """
    if name not in PROFILES:
        raise BadInputError("--profile", name, ", ".join(PROFILES))
    return PROFILES[name]
