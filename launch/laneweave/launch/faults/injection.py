"""Carrying out a faults file during a run: who is struck, when, and what is put right again.

The same for processes and for the simulated network: what can be done to a role is behind `Stage`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, Protocol

import structlog
from attrs import define, field, frozen

from laneweave.launch.faults.failover import Failover
from laneweave.launch.faults.schedule import Blow, FaultSchedule
from laneweave.launch.faults.specification import AGENT, COORDINATOR, LEADER, Faults
from laneweave.launch.observe.road_view import RoadView

log = structlog.get_logger(__name__)


class Stage(Protocol):
    """The roles of a run, as faults see them; all by their names."""

    @property
    def running(self) -> Collection[str]:
        """Roles that are up; paused ones are among them, killed ones are not."""

    @property
    def coordinators(self) -> Collection[str]:
        """All coordinators, up or not."""

    def agent_of(self, vehicle: str) -> str | None:
        """Return the role that drives a vehicle, if one has been started."""

    def kill(self, name: str) -> None:
        """End a role at once, without a word."""

    def pause(self, name: str) -> None:
        """Stop a role where it is."""

    def resume(self, name: str) -> None:
        """Let a paused role go on; nothing happens to one that has died meanwhile."""

    def start_again(self, name: str) -> None:
        """Start a role that was killed, with an empty memory."""


@frozen
class _Struck:
    """A role for which something is to be put right."""

    name: str
    due_s: float
    """Node clock."""
    paused: bool
    """To be resumed; otherwise: to be started again."""


@define
class FaultInjection:
    """All kills and pauses of one run."""

    stage: Stage
    schedule: FaultSchedule
    failover: Failover
    injected: list[dict[str, Any]] = field(factory=list)
    """What was done: road time, strike, verb, target."""
    _waiting: list[Blow] = field(factory=list)
    """Due, but there has been no target yet."""
    _struck: list[_Struck] = field(factory=list)
    _targets: dict[str, set[str]] = field(factory=dict)
    """Whom each strike has struck; agents are struck by each only once."""
    _paused: set[str] = field(factory=set)

    @classmethod
    def of(cls, faults: Faults, seed: int, stage: Stage, lease_s: float) -> FaultInjection:
        """Prepare the faults of a run; `seed` and `lease_s` are its scenario's."""
        return cls(stage, FaultSchedule(faults, seed), Failover(lease_s))

    @property
    def wakeup_s(self) -> float | None:
        """When `step` should be called at the latest, on the clock of `now_s`."""
        return min((struck.due_s for struck in self._struck), default=None)

    def step(self, road_s: float, now_s: float, view: RoadView) -> None:
        """Do what is due.

        Args:
            road_s: road time.
            now_s: the node's clock: wall-clock seconds, or those of the simulated network.
            view: who leads and who is on the road; a leader that is struck is taken out of it.
        """
        self._put_right(now_s)
        self.failover.look(view, now_s)
        self._waiting += self.schedule.due(road_s)
        waiting, self._waiting = self._waiting, []
        for blow in waiting:
            name = self._choose(blow, view)
            if name is None:
                self._waiting.append(blow)
            else:
                self._strike(blow, name, road_s, now_s, view)

    def never_happened(self) -> list[str]:
        """Return a line for each fault of which nothing has happened."""
        return self.schedule.never_happened(set(self._targets))

    def _put_right(self, now_s: float) -> None:
        due = [struck for struck in self._struck if struck.due_s <= now_s]
        self._struck = [struck for struck in self._struck if struck.due_s > now_s]
        for struck in due:
            if struck.paused:
                self._paused.discard(struck.name)
                self.stage.resume(struck.name)
            else:
                self.stage.start_again(struck.name)

    def _choose(self, blow: Blow, view: RoadView) -> str | None:
        running = [name for name in self.stage.running if name not in self._paused]
        target = blow.strike.target
        if target in (COORDINATOR, AGENT):
            candidates = sorted(self._candidates(blow, view, running))
            return blow.draw.choice(candidates) if candidates else None
        name = view.leader if target == LEADER else target
        if name not in running:
            name = self.stage.agent_of(target)
        return name if name in running else None

    def _candidates(self, blow: Blow, view: RoadView, running: Collection[str]) -> Iterator[str]:
        if blow.strike.target == COORDINATOR:
            yield from (name for name in self.stage.coordinators if name in running)
            return
        struck = self._targets.get(blow.strike_name, set())
        entries = view.census.on_road if view.census is not None else ()
        agents = dict.fromkeys(self.stage.agent_of(entry.vehicle) for entry in entries)
        for name in agents:
            if name is not None and name in running and name not in struck:
                yield name

    def _strike(self, blow: Blow, name: str, road_s: float, now_s: float, view: RoadView) -> None:
        self._targets.setdefault(blow.strike_name, set()).add(name)
        self.injected.append({"t_s": round(road_s, 3), "fault": blow.strike_name, blow.verb: name})
        log.warning(blow.verb, target=name, t_s=road_s, fault=blow.strike_name)
        if blow.for_s is not None:
            self.stage.pause(name)
            self._paused.add(name)
            self._struck.append(_Struck(name, now_s + blow.for_s, paused=True))
        else:
            self.stage.kill(name)
            if blow.restart_after_s is not None:
                again_s = now_s + blow.restart_after_s
                self._struck.append(_Struck(name, again_s, paused=False))
        if name == view.leader:
            self.failover.on_struck(view, now_s, blow.for_s)
