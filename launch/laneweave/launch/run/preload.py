"""Preparation of the fork server before its first fork; only the fork server imports this module.

Importing this module loads libraries, generates the code that converts messages and scenarios, and
computes the reference motions for the default limits, once for all role processes. It starts no
thread and opens no session or file. Finally it excludes all objects from garbage collection: a
collection writes to every object that it visits, so each process would copy all of them.
"""

from __future__ import annotations

import laneweave.coordinator.process  # noqa: F401
from laneweave.agents.process import warm_up
from laneweave.launch.run.roles import tune_garbage_collector
from laneweave.protocol.config.loading import parse_scenario
from laneweave.protocol.wire import codec

codec.warm_up()
warm_up(parse_scenario({}))
tune_garbage_collector()
