"""Workers: real processes that compute, fail, hang and are killed."""

from __future__ import annotations

import contextlib
import math
import os
import queue
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest

from laneweave.protocol.runtime import fork_server, worker_pool
from laneweave.protocol.runtime.node import STOPPED, Clock, Computed, Delegate
from laneweave.protocol.runtime.worker_pool import WorkerPool
from support import worker_jobs as jobs
from support.waiting import wait_until

pytestmark = pytest.mark.slow

Work = Callable[[float, Clock], Any]
WAIT_S = 60.0
"""Nothing here takes a tenth of this; it only guards against hanging."""


class Bench:
    """A pool, and what has come of its jobs."""

    def __init__(self, workers: int, warm_up: Callable[[], object] | None = None) -> None:
        """Start nothing yet."""
        self.pool = WorkerPool(workers, warm_up)
        self.done: queue.SimpleQueue[Computed] = queue.SimpleQueue()
        self._jobs = 0

    def order(self, work: Work, within_s: float = WAIT_S) -> int:
        """Order a job; returns its number."""
        self._jobs += 1
        job = Delegate(self._jobs, work, time.monotonic() + within_s)
        self.pool.submit(job, self.done.put)
        return self._jobs

    def do(self, work: Work, within_s: float = WAIT_S) -> Computed:
        """Have a job done."""
        job = self.order(work, within_s)
        computed = self.done.get(timeout=WAIT_S)
        assert computed.job == job
        return computed

    def process_id(self) -> int:
        """Return which process does jobs."""
        found = self.do(jobs.process_id).result
        assert isinstance(found, int)
        return found


@pytest.fixture(scope="module")
def one() -> Iterator[Bench]:
    """A pool of one worker that all tests share: each leaves it able to go on."""
    bench = Bench(1)
    with contextlib.closing(bench.pool):
        yield bench


@pytest.fixture(scope="module")
def two() -> Iterator[Bench]:
    bench = Bench(2)
    with contextlib.closing(bench.pool):
        yield bench


def is_gone(process_id: int) -> bool:
    try:
        return psutil.Process(process_id).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


# --- jobs -------------------------------------------------------------------------------------


def test_a_job_is_done_by_another_process(one: Bench) -> None:
    process_id = one.process_id()
    assert process_id != os.getpid()
    assert one.pool.process_ids == [process_id]
    assert one.process_id() == process_id


def test_workers_are_nicer_than_the_process_that_has_the_pool(one: Bench) -> None:
    assert one.do(jobs.niceness).result == os.nice(0) + worker_pool.NICENESS


def test_a_job_knows_how_much_time_is_left(one: Bench) -> None:
    assert 50.0 < one.do(jobs.left, within_s=60.0).result <= 60.0


def test_an_exception_is_the_jobs_error(one: Bench) -> None:
    before = one.process_id()
    computed = one.do(jobs.fail)
    assert (computed.result, computed.error) == (None, "ValueError: no such thing")
    assert one.process_id() == before


@pytest.mark.parametrize("within_s", [0.0, -1.0, -math.inf])
def test_a_job_whose_deadline_has_passed_is_not_begun(
    one: Bench, tmp_path: Path, within_s: float
) -> None:
    computed = one.do(partial(jobs.note, tmp_path / "begun"), within_s)
    assert (computed.result, computed.error) == (
        None,
        "the deadline passed before the computation began",
    )
    assert not jobs.noted(tmp_path / "begun")


def test_a_deadline_that_passes_while_the_job_waits_counts(one: Bench, tmp_path: Path) -> None:
    one.process_id()  # has begun
    first = one.order(partial(jobs.sleep, 0.2))
    second = one.order(partial(jobs.note, tmp_path / "begun"), within_s=0.1)
    assert one.done.get(timeout=WAIT_S) == Computed(first, 0.2)
    assert one.done.get(timeout=WAIT_S) == Computed(
        second, None, "the deadline passed before the computation began"
    )
    assert not jobs.noted(tmp_path / "begun")


@pytest.mark.parametrize(
    "work",
    [lambda *_: None, jobs.Shy(), jobs.lock, jobs.shy],
    ids=["job", "job there", "result", "result here"],
)
def test_what_cannot_be_pickled_is_an_error_of_its_job_only(one: Bench, work: Work) -> None:
    before = one.process_id()
    computed = one.do(work)
    assert computed.result is None
    assert computed.error
    assert one.process_id() == before


def test_workers_work_at_the_same_time(two: Bench, tmp_path: Path) -> None:
    for _ in range(2):
        two.order(partial(jobs.meet, tmp_path / "here"))
    met = {two.done.get(timeout=WAIT_S).result for _ in range(2)}
    assert met == set(two.pool.process_ids)
    assert len(met) == 2


# --- workers that die or hang -----------------------------------------------------------------


@pytest.mark.parametrize("with_a_job", [True, False])
def test_an_idle_worker_that_is_killed_is_replaced(one: Bench, *, with_a_job: bool) -> None:
    before = one.process_id()
    os.kill(before, signal.SIGKILL)
    if not with_a_job:
        wait_until(lambda: one.pool.process_ids not in ([before], []), WAIT_S)
    assert one.process_id() not in (before, os.getpid())
    assert one.pool.process_ids == [one.process_id()]


def test_the_job_of_a_worker_that_is_killed_is_done_by_another(two: Bench, tmp_path: Path) -> None:
    file = tmp_path / "begun"
    job = two.order(partial(jobs.hang_at_first, file))
    wait_until(lambda: len(jobs.noted(file)) == 1, WAIT_S)
    (killed,) = jobs.noted(file)
    # The other worker is not disturbed.
    assert two.do(jobs.process_id).result != killed
    os.kill(killed, signal.SIGKILL)
    computed = two.done.get(timeout=WAIT_S)
    assert (computed.job, computed.error) == (job, "")
    assert computed.result == jobs.noted(file)[1] != killed


def test_a_job_that_kills_each_worker_is_tried_twice(one: Bench, tmp_path: Path) -> None:
    computed = one.do(partial(jobs.die, tmp_path / "begun"))
    assert (computed.result, computed.error) == (None, "the worker died")
    assert len(set(jobs.noted(tmp_path / "begun"))) == 2
    assert one.process_id() not in jobs.noted(tmp_path / "begun")


@pytest.mark.parametrize("number", [0, signal.SIGSTOP], ids=["busy", "stopped"])
def test_a_worker_that_goes_on_too_long_is_killed(
    one: Bench, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    before = one.process_id()
    monkeypatch.setattr(worker_pool, "OVERDUE_S", 0.1)
    one.order(partial(jobs.sleep, 1000.0), within_s=0.1)
    os.kill(before, number)
    assert one.done.get(timeout=WAIT_S).error == "the worker was killed: it exceeded its deadline"
    wait_until(lambda: is_gone(before), WAIT_S)
    monkeypatch.undo()
    assert one.process_id() != before


# --- jobs that are stopped --------------------------------------------------------------------


def test_a_stopped_job_ends_and_its_worker_continues(
    one: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # It stops by itself, also on a busy machine.
    monkeypatch.setattr(worker_pool, "STOP_S", WAIT_S)
    before = one.process_id()
    job = one.order(partial(jobs.read_clock, tmp_path / "begun"))
    wait_until(lambda: jobs.noted(tmp_path / "begun") == [before], WAIT_S)
    one.pool.stop(job)
    assert one.done.get(timeout=WAIT_S) == Computed(job, None, STOPPED)
    assert one.process_id() == before


def test_a_stopped_job_that_waits_is_not_begun(one: Bench, tmp_path: Path) -> None:
    running = one.order(partial(jobs.sleep, 0.2))
    waiting = one.order(partial(jobs.note, tmp_path / "begun"))
    one.pool.stop(waiting)
    assert one.done.get(timeout=WAIT_S) == Computed(running, 0.2)
    assert one.done.get(timeout=WAIT_S) == Computed(waiting, None, STOPPED)
    assert not jobs.noted(tmp_path / "begun")


def stop_after_begin(bench: Bench, file: Path) -> int:
    """Stop a job that does not read its clock; return the process that had begun it."""
    job = bench.order(partial(jobs.hang_at_first, file))
    wait_until(lambda: len(jobs.noted(file)) == 1, WAIT_S)
    bench.pool.stop(job)
    assert bench.done.get(timeout=WAIT_S) == Computed(job, None, STOPPED)
    (process,) = jobs.noted(file)
    return process


def is_reaped(process_id: int) -> bool:
    return not psutil.pid_exists(process_id)


def test_a_worker_whose_job_does_not_stop_is_killed(one: Bench, tmp_path: Path) -> None:
    before = one.process_id()
    assert stop_after_begin(one, tmp_path / "begun") == before
    assert one.process_id() != before
    assert jobs.noted(tmp_path / "begun") == [before]


def test_a_worker_that_replaces_another_is_ready_at_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # An interpreter that starts, and what it loads, would delay the next client by a second or two.
    bench = Bench(1, partial(jobs.note, tmp_path / "loaded"))
    with contextlib.closing(bench.pool):
        server = psutil.Process(bench.process_id()).ppid()
        monkeypatch.setattr(fork_server._SPAWN.Process, "start", None)  # no other one can start
        for number in range(3):
            killed = stop_after_begin(bench, tmp_path / f"begun-{number}")
            process = bench.process_id()
            assert process != killed
            assert psutil.Process(process).ppid() == server
            wait_until(partial(is_reaped, killed), WAIT_S)
    assert set(jobs.noted(tmp_path / "loaded")) == {server}


def test_a_fork_server_that_is_killed_is_replaced(one: Bench) -> None:
    before = one.process_id()
    server = psutil.Process(before).ppid()
    os.kill(server, signal.SIGKILL)
    wait_until(lambda: is_gone(before), WAIT_S)
    assert psutil.Process(one.process_id()).ppid() not in (server, 1, os.getpid())


@pytest.mark.parametrize("fork", [False, True])
def test_workers_outlive_a_signal_to_the_whole_group(*, fork: bool) -> None:
    # The process that has the pool may still finish what is running.
    bench = Bench(1)
    with contextlib.closing(bench.pool):
        if fork:
            bench.pool.fork()
        before = bench.process_id()
        for process in (before, psutil.Process(before).ppid()):
            os.kill(process, signal.SIGTERM)
        assert bench.process_id() == before


def test_stopping_a_complete_job_has_no_effect(one: Bench) -> None:
    job = one.order(jobs.process_id)
    before = one.done.get(timeout=WAIT_S).result
    one.pool.stop(job)
    one.pool.stop(job + 1)
    assert one.process_id() == before


def test_a_machine_that_gives_no_process_is_an_error_of_the_job(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise BlockingIOError("no process")

    bench = Bench(1)
    with contextlib.closing(bench.pool):
        with monkeypatch.context() as patch:
            patch.setattr(fork_server._SPAWN.Process, "start", refuse)
            assert bench.do(jobs.process_id).error == "the worker died"
        worker = bench.process_id()
        # The server of a moment ago may still be the one that is asked.
        wait_until(lambda: worker in bench.pool.process_ids, WAIT_S)


# --- begin and end ----------------------------------------------------------------------------


def test_closing_waits_for_no_job(tmp_path: Path) -> None:
    bench = Bench(2)
    for _ in range(5):
        bench.order(partial(jobs.hang_at_first, tmp_path / "begun"))
    wait_until(lambda: len(jobs.noted(tmp_path / "begun")) == 5, WAIT_S)
    processes = bench.pool.process_ids

    begun_s = time.monotonic()
    bench.pool.close()
    # Nothing is waited for: this is for a machine with much else to do.
    assert time.monotonic() < begun_s + 2.0

    assert len(processes) == 2
    assert all(is_gone(process) for process in processes)
    assert bench.pool.process_ids == []
    bench.pool.close()


OWNER = """
import sys, time
from functools import partial
from pathlib import Path
from laneweave.protocol.runtime.node import Delegate
from laneweave.protocol.runtime.worker_pool import WorkerPool
from support import worker_jobs as jobs

if __name__ == "__main__":
    folder, fork = Path(sys.argv[1]), sys.argv[2] == "True"
    pool = WorkerPool(2, partial(jobs.note, folder / "warm"))
    if fork:
        pool.fork()
    met = []
    meet = partial(jobs.meet, folder / "met")
    for number in range(2):
        pool.submit(Delegate(number, meet, time.monotonic() + 60), met.append)
    while len(met) < 2:
        time.sleep(0.01)
    pool.submit(Delegate(3, partial(jobs.sleep, 1000.0), time.monotonic() + 60), met.append)
    print(*pool.process_ids, flush=True)
    time.sleep(1000.0)
"""


@pytest.mark.parametrize("fork", [False, True])
def test_workers_die_with_the_process_that_has_the_pool(tmp_path: Path, *, fork: bool) -> None:
    script = tmp_path / "owner.py"
    script.write_text(OWNER, encoding="utf-8")
    environment = dict(os.environ) | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, str(script), str(tmp_path), str(fork)],
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    ) as owner:
        try:
            assert owner.stdout is not None
            workers = [int(word) for word in owner.stdout.readline().split()]
            assert len(set(workers)) == 2
            # One process loads what all of them need, and is no worker.
            warm = set(jobs.noted(tmp_path / "warm"))
            assert len(warm - {*workers, owner.pid}) == len(warm) == 1
        finally:
            owner.kill()
    wait_until(lambda: all(is_gone(each) for each in (*workers, *warm)), WAIT_S)
