"""Whether one process of a deployment is well, as the network sees it: for health checks."""

from __future__ import annotations

from collections.abc import Callable

from attrs import field, frozen

from laneweave.launch.observe.status import road_problem
from laneweave.launch.observe.tally import Tally

COORDINATOR, BRIDGE, AGENT = "coordinator", "bridge", "agent"


@frozen
class RoleHealth:
    """What is asked of one process."""

    role: str
    """One of the three above."""
    name: str = ""
    """Of the coordinator; of the vehicle, or of the shard that `takes` tells the vehicles of."""
    takes: Callable[[str], bool] = field(default=lambda _: False)
    """Tells whether a vehicle falls to the shard; unused for a vehicle's name."""
    is_shard: bool = False

    def problem(self, tally: Tally, now_s: float, election_s: float) -> str | None:
        """Return what is wrong so far, None: nothing.

        Args:
            tally: what was heard.
            now_s: now, on the tally's clock.
            election_s: a heartbeat may be this old.
        """
        if not tally.linked:
            return "the connection to the router was lost"
        if self.role == COORDINATOR:
            return self._coordinator(tally, now_s, election_s)
        if self.role == BRIDGE:
            if not tally.bridges:
                return "no bridge is there"
            return road_problem(tally, now_s - tally.began_s)
        if self.is_shard:
            return self._shard(tally)
        return None if self.name in tally.agents else f"{self.name}: its agent is not there"

    def may_end_early(self, tally: Tally) -> bool:
        """Tell whether enough was heard to believe that nothing is wrong."""
        return not self.is_shard or tally.road.census is not None

    def _coordinator(self, tally: Tally, now_s: float, election_s: float) -> str | None:
        there = [process for process in tally.candidates if process[0] == self.name]
        if not there:
            return f"coordinator {self.name} is not there"
        heard = [tally.heartbeats[process][1] for process in there if process in tally.heartbeats]
        if heard and now_s - max(heard) < election_s:
            return None
        return f"coordinator {self.name} is there, but was not heard for {election_s:g} s"

    def _shard(self, tally: Tally) -> str | None:
        """A shard without vehicles on the road is well: nothing can be asked of it."""
        census = tally.road.census
        if census is None:
            return None
        states = tally.road.states
        alone = [
            entry.vehicle
            for entry in census.on_road
            if self.takes(entry.vehicle)
            and (
                entry.vehicle not in tally.agents
                or (entry.vehicle in states and not states[entry.vehicle].attended)
            )
        ]
        if not alone:
            return None
        return f"shard {self.name}: {len(alone)} vehicles are unattended, {alone[0]} among them"
