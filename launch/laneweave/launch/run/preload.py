"""Preparation of the fork server before its first fork; only the fork server imports this module.

Importing this module loads libraries and the planners that are compiled, generates the code
that converts scenarios, and computes the reference motions for the default limits,
once for all role processes. It starts no thread and opens no session or file. Finally it excludes
all objects from garbage collection: a collection writes to every object that it visits, so each
process would copy all of them.
"""

from __future__ import annotations

import os
import signal

import laneweave.coordinator.process  # noqa: F401
from laneweave.agents import process as agents
from laneweave.coordinator.planning.kernels import KERNELS
from laneweave.launch.run.roles import LAUNCHER, tune_garbage_collector
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.runtime.processes import die_with_parent, outlive_parent

# The fork server itself notices the end of its launcher only after this preparation; from then on
# it must outlive the launcher until its last child has exited. All stop signals are blocked here.
die_with_parent(int(os.environ.pop(LAUNCHER)), signal.SIGKILL)
agents.warm_up(parse_scenario({}))
for kernels in KERNELS.values():
    kernels.load_if_compiled()
outlive_parent()
# The roles inherit this: the launcher ends them, in the right order. SIGINT remains blocked,
# because OSQP replaces its handler.
for number in (signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGTERM, signal.SIGHUP))
tune_garbage_collector()
