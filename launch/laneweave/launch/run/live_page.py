"""The live page of a run: a process that the launcher starts with the run and ends after it.

Only that process imports the web server, which takes as long as all else that a launcher imports.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import socket
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from types import TracebackType
from typing import Any

from attrs import define

from laneweave.launch.run.logs import log_to_file
from laneweave.launch.run.roles import AGENT_NICENESS, become_role, end_role
from laneweave.launch.run.run_folder import LOG_FILE
from laneweave.launch.watch.listening import address_of, open_socket
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError

OPTION = "--watch-listen"
DEFAULT_LISTEN = "127.0.0.1:8080"
"""If this address is in use, a free port is chosen."""
FREE_PORT = "127.0.0.1:0"
END_S = 5.0
"""Grace period for browsers to receive how the run has ended."""
NAME = "watch"
SERVER = "laneweave.launch.watch.process"
PACKAGES = ("starlette", "uvicorn", "websockets")
"""Packages that the server needs, of the extra `watch`."""


@define
class LivePage:
    """A page whose address is known before the run starts; a context manager.

    It is no role: faults do not affect it, and a run does not fail with it.
    """

    listener: socket.socket
    address: str
    _process: ForkServerProcess | None = None
    _connection: Connection | None = None

    @classmethod
    def open(cls, listen: str | None) -> LivePage:
        """Reserve an address, HOST:PORT; None: `DEFAULT_LISTEN`.

        Raises:
            BadInputError: the address cannot be used.
            ModuleNotFoundError: a package of the web server is not installed.
        """
        for package in PACKAGES:
            if importlib.util.find_spec(package) is None:
                raise ModuleNotFoundError(f"no module named {package}", name=package)
        try:
            listener = open_socket(listen or DEFAULT_LISTEN, OPTION)
        except BadInputError:
            if listen is not None:
                raise
            listener = open_socket(FREE_PORT, OPTION)
        return cls(listener, address_of(listener))

    def __enter__(self) -> LivePage:
        """Return this page."""
        return self

    def __exit__(
        self, _: type[BaseException] | None, __: BaseException | None, ___: TracebackType | None
    ) -> None:
        """End the process."""
        self.end()

    def start(
        self, context: ForkServerContext, tables: dict[str, Any], options: dict[str, Any]
    ) -> None:
        """Start the process, once the router listens.

        Args:
            context: result of `fork_server`.
            tables: the scenario, as returned by `to_tables`.
            options: options that every role receives.
        """
        self._connection, theirs = context.Pipe()
        arguments = (tables, options, self.listener, theirs)
        self._process = context.Process(target=_serve_page, args=arguments, name=NAME)
        self._process.start()
        theirs.close()

    def end(self, text: str = "") -> None:
        """End the process; its page shows a text, if one is given."""
        self.listener.close()
        process, self._process = self._process, None
        if process is None or self._connection is None:
            return
        with contextlib.suppress(OSError):
            if text:
                self._connection.send(text)
        self._connection.close()
        process.join(END_S)
        end_role(process)
        process.join(END_S)
        if process.is_alive():
            process.kill()
            process.join(END_S)
        process.close()


def _serve_page(
    tables: dict[str, Any], options: dict[str, Any], listener: socket.socket, launcher: Connection
) -> None:
    """Serve the page of a run; the target of its process."""
    with contextlib.suppress(KeyboardInterrupt):
        become_role(NAME, options)
        folder = Path(options["folder"])
        log_to_file(folder / LOG_FILE, NAME, NAME)
        # The roles take priority.
        os.nice(AGENT_NICENESS)
        process = importlib.import_module(SERVER)
        process.watch_run(parse_scenario(tables), folder.resolve().name, listener, launcher)
