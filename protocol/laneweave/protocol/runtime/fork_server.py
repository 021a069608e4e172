"""A process that forks worker processes, so that a new one is ready within milliseconds.

A process that imports the planners needs more than a second of computing before its first job. The
fork server imports them once, has a single thread and runs no jobs, so its forks are ready at once.
It kills its workers and exits when the pool closes it or the parent dies. If the server dies, so do
its workers.

The pool sends a worker's number, with the connection for a new process or without it. A process
that cannot be started closes its connection.
"""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import select
import signal
import socket
import struct
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import ForkContext, SpawnContext
from multiprocessing.process import BaseProcess
from typing import NoReturn

import structlog

from laneweave.protocol.runtime.processes import STOP_SIGNALS, die_with_parent

log = structlog.get_logger(__name__)

END_S = 2.0
"""Maximum wait for a process that was asked to exit."""
REAP_S = 0.5
"""Interval at which the server looks for killed processes that have exited: the kernel may need
some time to free their memory."""

_SPAWN = multiprocessing.get_context("spawn")
_FORK = multiprocessing.get_context("fork")
_NUMBER = struct.Struct("i")

Work = Callable[[int, Connection], None]
"""Main function of a worker process; gets the worker's number and its connection to the pool."""


class ForkServer:
    """The fork server of a pool, as seen by the pool; its methods may be called in any thread."""

    def __init__(self, workers: int, work: Work, warm_up: Callable[[], object] | None) -> None:
        """Start nothing yet.

        Args:
            workers: number of workers.
            work: picklable main function of a worker process.
            warm_up: picklable function that loads what workers need; called before each fork, so
                it should return at once if there is nothing more to load.
        """
        self._work = work
        self._warm_up = warm_up
        self._process_ids = _SPAWN.RawArray(ctypes.c_int64, workers)
        """Process id of each worker, set by the server; 0: none."""
        self._lock = threading.Lock()
        """Guards the fields below."""
        self._server: BaseProcess | None = None
        self._control: socket.socket | None = None
        self._closed = False

    @property
    def process_ids(self) -> list[int]:
        """Process ids of the workers."""
        return [process_id for process_id in self._process_ids if process_id]

    def start(self, *, fork: bool) -> None:
        """Start the server: as a fork of this process, or as a new process.

        A fork would inherit the sockets and locked state of Zenoh and of other threads.
        """
        with self._lock:
            self._start(_FORK if fork else _SPAWN)

    def fork(self, worker: int) -> Connection:
        """Start a worker process, in place of an earlier one, which is killed.

        A server that has died is replaced.

        Returns:
            The connection to the new process, which may not have started yet.

        Raises:
            OSError: the server cannot be replaced, or it is closed.
        """
        ours, theirs = multiprocessing.Pipe()
        with theirs:
            try:
                with self._lock:
                    if not self._send(worker, theirs):
                        self._start(_SPAWN)
                        self._send(worker, theirs)
            except OSError:
                ours.close()
                raise
        return ours

    def kill(self, worker: int) -> None:
        """Kill the process of a worker, if there is one; does not wait until it has exited."""
        with self._lock:
            self._send(worker)

    def close(self) -> None:
        """Kill all workers, and end the server."""
        with self._lock:
            self._closed = True
            self._end()

    def _start(self, context: SpawnContext | ForkContext) -> None:
        self._end()
        if self._closed:
            raise OSError("the fork server is closed")
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        inherited = ours if context is _FORK else None
        with theirs:
            arguments = theirs, inherited, self._work, self._warm_up, self._process_ids
            server = context.Process(target=_serve, args=arguments, name="forks", daemon=True)
            try:
                server.start()
            except OSError:
                ours.close()
                raise
        self._server, self._control = server, ours

    def _send(self, worker: int, connection: Connection | None = None) -> bool:
        """Send a worker's number, and the connection for its new process, if it needs one.

        Returns:
            False if there is no server.
        """
        if self._control is None:
            return False
        descriptors = [] if connection is None else [connection.fileno()]
        try:
            socket.send_fds(self._control, [_NUMBER.pack(worker)], descriptors)
        except OSError:  # the server has died
            return False
        return True

    def _end(self) -> None:
        has_workers = bool(self.process_ids)  # before the server sees the end
        if self._control is not None:
            self._control.close()
            self._control = None
        if self._server is not None:
            if has_workers:
                self._server.join(END_S)
            self._server.kill()
            self._server.join(END_S)
            self._server = None
        self._process_ids[:] = [0] * len(self._process_ids)


def _serve(
    control: socket.socket,
    inherited: socket.socket | None,
    work: Work,
    warm_up: Callable[[], object] | None,
    process_ids: ctypes.Array[ctypes.c_int64],
) -> None:
    """Fork and kill workers until the pool closes its socket; main function of the server.

    Args:
        control: socket of the server.
        inherited: socket of the pool, in a server that is a fork.
        work: see `ForkServer`.
        warm_up: see `ForkServer`.
        process_ids: see `ForkServer.process_ids`.
    """
    if inherited is not None:
        inherited.close()
    # These signals reach the whole process group, but the parent may still need the workers.
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    _Workers(control, work, warm_up, process_ids).serve()


class _Workers:
    """The workers of a fork server, in its process."""

    def __init__(
        self,
        control: socket.socket,
        work: Work,
        warm_up: Callable[[], object] | None,
        process_ids: ctypes.Array[ctypes.c_int64],
    ) -> None:
        self._control = control
        self._work = work
        self._warm_up = warm_up or (lambda: None)
        self._process_ids = process_ids
        self._killed: list[int] = []
        """Processes that may not have exited yet."""

    def serve(self) -> None:
        """Obey the pool until it closes its socket."""
        self._warm_up()
        gc.freeze()  # otherwise a collection would copy the pages that forks share
        while True:
            self._wait()
            received, descriptors, _, _ = socket.recv_fds(self._control, _NUMBER.size, 1)
            if not received:
                break
            (worker,) = _NUMBER.unpack(received)
            self._kill(worker)
            if descriptors:
                self._fork(worker, descriptors[0])
        for worker in range(len(self._process_ids)):
            self._kill(worker)
        for process_id in self._killed:
            os.waitpid(process_id, 0)

    def _wait(self) -> None:
        """Wait until the pool sends something; meanwhile, reap the killed processes."""
        while self._killed and not select.select([self._control], [], [], REAP_S)[0]:
            self._reap()

    def _fork(self, worker: int, descriptor: int) -> None:
        server = os.getpid()
        try:
            self._warm_up()
            process_id = os.fork()
            if process_id == 0:
                self._become_worker(worker, descriptor, server)
            self._process_ids[worker] = process_id
        except OSError as error:
            log.warning("a worker cannot be started", reason=str(error))
        finally:
            os.close(descriptor)

    def _become_worker(self, worker: int, descriptor: int, server: int) -> NoReturn:
        status = 1
        try:
            die_with_parent(server, signal.SIGKILL)
            self._control.close()
            self._work(worker, Connection(descriptor))
            status = 0
        except Exception:
            log.exception("a worker ends after an error")
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
            os._exit(status)

    def _kill(self, worker: int) -> None:
        process_id = self._process_ids[worker]
        self._process_ids[worker] = 0
        if process_id:
            os.kill(process_id, signal.SIGKILL)  # not reaped, so the number is still its own
            self._killed.append(process_id)

    def _reap(self) -> None:
        self._killed = [each for each in self._killed if os.waitpid(each, os.WNOHANG)[0] == 0]
