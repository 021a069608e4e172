"""What the fork server does before its first fork; it imports this module, and nobody else does.

What is done here is done once and not by each process: loading libraries, generating the code that
reads and writes messages and scenarios, planning the moves of vehicles with the default limits (a
scenario with others gains all the rest). Nothing is opened: no session, no thread, no file.

Last of all, whatever is there by now is taken out of garbage collection, and the rest is seldom
looked at. It lives as long as its process, and a collection writes to every object that it looks
at: each process would soon have a copy of its own of all of it.
"""

from __future__ import annotations

import laneweave.coordinator.process
import laneweave.launch.cli.entry
import laneweave.launch.run.roles  # noqa: F401 (its processes begin there)
from laneweave.agents.process import warm_up
from laneweave.launch.run.garbage_collection import collect_seldom
from laneweave.protocol.config.loading import parse_scenario
from laneweave.protocol.wire import codec

codec.warm_up()
warm_up(parse_scenario({}))
collect_seldom()
