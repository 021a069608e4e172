"""Faults of processes: kills, pauses, second processes, restarts of the road, wrong clocks."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Protocol

from laneweave.launch.fault_search.events.fault_context import LONG_S, ROAD, SHORT_S, FaultContext

CLOCK_JUMP_S = (-2.0, 2.0)
PAUSED_TWINS = 0.3
"""Share of vehicles with two processes of which the first one is paused."""
NO_RESTART = 0.25
"""Share of killed agents that are restarted only after the fault phase."""

Hinder = Callable[[Callable[[str, str, str], float], str], None]
"""Delays messages for some time; arguments: extra delay [s] of a message, text for the end."""


class Processes(Protocol):
    """Process operations needed by fault events."""

    coordinators: tuple[str, ...]

    @property
    def agents(self) -> tuple[str, ...]:
        """Agents of the vehicles that have not left the road."""

    @property
    def leaders(self) -> tuple[str, ...]:
        """Coordinators that consider themselves the leader."""

    def start(self, name: str) -> None:
        """Start a process unless it is running; the road begins anew."""

    def start_twin(self, name: str) -> str:
        """Start a second process for the vehicle of an agent, and return its name."""

    def jump_clock(self, name: str, jump_s: float) -> None:
        """Change the clock of a vehicle or coordinator; 0: end its error by jumps."""


class ProcessFaults:
    """Faults of the processes of one run; each returns whether it had an effect."""

    def __init__(self, context: FaultContext, processes: Processes, hinder: Hinder) -> None:
        """Prepare faults of processes; `hinder` delays messages between them."""
        self._context = context
        self._processes = processes
        self._hinder = hinder
        self.refused: set[str] = set()
        """Vehicles whose controllers refuse all motions."""
        self._twins: list[str] = []
        self._jumped: set[str] = set()

    def kill(self, name: str, *, may_stay_dead: bool = False) -> bool:
        """Kill a process; an agent that `may_stay_dead` is sometimes restarted only at the end."""
        if name not in self._context.network:
            return False
        self._context.network.kill(name)
        if not (may_stay_dead and self._context.rng.random() < NO_RESTART):
            self._context.later(
                SHORT_S, partial(self._processes.start, name), f"{name} is restarted"
            )
        return True

    def kill_coordinators(self, _: str) -> bool:
        """Kill all coordinators at once, so that none of the next ones knows earlier terms."""
        killed = [self.kill(name) for name in self._processes.coordinators]
        return any(killed)

    def pause(self, name: str) -> bool:
        """Pause a process for some time."""
        if name not in self._context.network:
            return False
        self._context.network.pause(name)
        resume = partial(self._if_present, name, self._context.network.resume)
        self._context.later(SHORT_S, resume, f"{name} resumes")
        return True

    def restart_road(self, _: str) -> bool:
        """Kill the road with all vehicles; another one begins later."""
        return self.kill(ROAD)

    def refuse(self, name: str) -> bool:
        """Let the motion controller of a vehicle refuse all motions for some time."""
        self.refused.add(name)
        self._context.later(
            LONG_S, partial(self.refused.discard, name), f"{name} accepts motions again"
        )
        return True

    def jump_clock(self, name: str) -> bool:
        """Let the clock of a vehicle or coordinator jump."""
        self._jumped.add(name)
        self._processes.jump_clock(name, self._context.rng.uniform(*CLOCK_JUMP_S))
        return True

    def start_twin(self, name: str) -> bool:
        """Start a second process for a vehicle; the first one pauses, or receives no SENSE."""
        if name not in self._context.network or name not in self._processes.agents:
            return False
        twin = self._processes.start_twin(name)
        if twin in self._twins:
            return False
        self._twins.append(twin)
        if self._context.rng.random() < PAUSED_TWINS:
            self.pause(name)
        else:
            self._hinder(
                lambda sender, receiver, _: math.inf if (sender, receiver) == (ROAD, name) else 0.0,
                f"{name} receives SENSE again",
            )
        victim = self._context.rng.choice((name, twin))
        kill = partial(self._if_present, victim, self._context.network.kill)
        self._context.later(LONG_S, kill, f"{victim} is killed")
        return True

    def disconnect(self, name: str) -> bool:
        """Disconnect a process for some time."""
        if name not in self._context.network:
            return False
        self._context.network.disconnect(name)
        reconnect = partial(self._if_present, name, self._context.network.reconnect)
        self._context.later(SHORT_S, reconnect, f"{name} is connected again")
        return True

    def kill_agent(self, name: str) -> bool:
        """Kill an agent, which is sometimes restarted only after the fault phase."""
        return self.kill(name, may_stay_dead=True)

    def heal(self) -> None:
        """End the faults of processes, except wrong clocks."""
        network = self._context.network
        self.refused.clear()
        for name in self._twins:
            network.kill(name)
        for name in network.names:
            # A resumed process handles its queued messages, and may exit.
            network.resume(name)
            self._if_present(name, network.reconnect)
        for name in (ROAD, *self._processes.coordinators, *self._processes.agents):
            self._processes.start(name)
        for name in sorted(self._jumped):
            self._processes.jump_clock(name, 0.0)

    def _if_present(self, name: str, action: Callable[[str], None]) -> None:
        if name in self._context.network:
            action(name)
