"""The faults of a local run: what its processes get to have them, and what is done to them."""

from __future__ import annotations

from collections.abc import Mapping
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import structlog
from attrs import define, field

from laneweave.launch.faults.control_files import SharedBoard
from laneweave.launch.faults.injection import FaultInjection
from laneweave.launch.faults.network_namespaces import HUB, GroupNetwork, NamespacesUnavailableError
from laneweave.launch.faults.specification import (
    MESSAGES,
    NAMESPACES,
    SENDER_OF_GROUP,
    Faults,
    Partition,
)
from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.role_processes import ROUTER, Order, RoleProcesses
from laneweave.launch.run.roles import MessageFaults
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.runtime.message_faults import SENDER_OF_ROLE, MessageRule
from laneweave.protocol.scenario.tables import Scenario

log = structlog.get_logger(__name__)

_GROUP_OF_SENDER = {sender: group for group, sender in SENDER_OF_GROUP.items()}


@define
class ProcessFaults:
    """All that a run with faults has and a run without has not."""

    faults: Faults
    scenario: Scenario
    board: SharedBoard
    injection: FaultInjection
    network: GroupNetwork | None
    """Namespaces for the partitions that use them; none: messages do it."""
    why_no_network: str = ""
    _starts: dict[str, int] = field(factory=dict)
    _in_force: set[str] = field(factory=set)
    _injected: list[dict[str, Any]] = field(factory=list)

    @classmethod
    def open(
        cls, faults: Faults, scenario: Scenario, processes: RoleProcesses, folder: Path
    ) -> ProcessFaults:
        """Prepare the faults of a run.

        Args:
            faults: of its faults file.
            scenario: of the run.
            processes: of the run; none has been started yet.
            folder: its temporary folder.

        Raises:
            BadInputError: a partition insists on namespaces, and there can be none.
        """
        network, reason = _open_network(faults, processes.context)
        lease_s = scenario.network.lease_s
        injection = FaultInjection.of(faults, scenario.seed, processes, lease_s)
        board = SharedBoard(folder / "board")
        return cls(faults, scenario, board, injection, network, reason)

    def equip(
        self, order: Order, tables: Mapping[str, Any], options: Mapping[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the scenario's tables and the options for a role that is to have the faults."""
        tables, options = dict(tables), dict(options)
        network, sender = self.network, SENDER_OF_ROLE.get(order.role)
        if network is not None and order.role == ROUTER:
            options |= {"namespace": network.process_id(HUB), "listen": (network.listen,)}
        if sender is not None:
            group = _GROUP_OF_SENDER[sender]
            if network is not None and group in network.groups:
                options["namespace"] = network.process_id(group)
                tables["network"] = tables["network"] | {"endpoint": network.endpoint}
            options["faults"] = self._message_faults(order, sender)
        return tables, options

    def _message_faults(self, order: Order, sender: str) -> MessageFaults:
        start = self._starts[order.name] = self._starts.get(order.name, 0) + 1
        faults = self.faults
        seed = self.scenario.seed if faults.seed is None else faults.seed
        return MessageFaults(
            rules=self._rules(),
            board=self.board.path,
            word=self.board.new_word(),
            receiver=sender,
            seed=f"{seed}/{order.name}/{start}",
        )

    def _rules(self) -> tuple[MessageRule, ...]:
        partitions = (
            rule
            for partition in self.faults.partition
            if not self._cuts_links(partition)
            for rule in partition.message_rules()
        )
        return (*self.faults.messages, *partitions)

    def _cuts_links(self, partition: Partition) -> bool:
        return self.network is not None and partition.may_use_links

    def step(self, now_s: float, view: RoadView) -> None:
        """Do what is due; `now_s` is wall-clock time.

        Raises:
            CommandFailedError: a process cannot be started again, or a link not be changed.
        """
        road_s = self.board.road_s
        self.injection.step(road_s, now_s, view)
        self._partition(road_s)

    def _partition(self, road_s: float) -> None:
        in_force = {
            f"partition[{index}]": partition
            for index, partition in enumerate(self.faults.partition)
            if partition.holds(road_s)
        }
        if in_force.keys() == self._in_force:
            return
        if self.network is not None:
            cut = {part.between[0] for part in in_force.values() if self._cuts_links(part)}
            try:
                self.network.cut_off(cut)
            except NamespacesUnavailableError as error:
                raise CommandFailedError(f"cannot change a link: {error}") from error
        for name in sorted(in_force.keys() ^ self._in_force):
            verb = "began" if name in in_force else "ended"
            self._injected.append({"t_s": round(road_s, 3), "fault": name, "partition": verb})
            log.warning("partition", t_s=road_s, fault=name, state=verb)
        self._in_force = set(in_force)

    def summary(self) -> dict[str, Any]:
        """Return what was done, for summary.json."""
        methods = {
            f"partition[{index}]": NAMESPACES if self._cuts_links(partition) else MESSAGES
            for index, partition in enumerate(self.faults.partition)
        }
        found: dict[str, Any] = {
            "injected": sorted(
                [*self.injection.injected, *self._injected], key=lambda one: float(one["t_s"])
            ),
            "partition_methods": methods,
        }
        if self.why_no_network:
            found["why_no_namespaces"] = self.why_no_network
        return found

    def close(self) -> None:
        """Give everything back; to be called when all processes have ended."""
        if self.network is not None:
            self.network.close()


def _open_network(faults: Faults, context: ForkServerContext) -> tuple[GroupNetwork | None, str]:
    """Return the namespaces that the partitions need and can have, or why there are none."""
    groups = dict.fromkeys(part.between[0] for part in faults.partition if part.may_use_links)
    if not groups:
        return None, ""
    network = GroupNetwork(context, tuple(groups))
    try:
        network.open()
    except NamespacesUnavailableError as error:
        for index, partition in enumerate(faults.partition):
            if partition.method == NAMESPACES:
                allowed = f"messages, since there can be none here ({error})"
                raise BadInputError(f"partition[{index}].method", NAMESPACES, allowed) from error
        return None, str(error)
    return network, ""
