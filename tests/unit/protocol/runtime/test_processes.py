"""Stop signals: handled once, deferred, ignored if the parent ignored them."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import termios

import pytest

from support.commands import python

PROGRAM = """
import os, signal, sys, time
from laneweave.protocol.runtime import processes as p
def send(*numbers):
    for number in numbers:
        os.kill(os.getpid(), number)
def wait_for_signal():
    # A signal just before one long sleep would be handled only after it.
    for _ in range(6000):
        time.sleep(0.01)
HUP, TERM, INT, USR1 = signal.SIGHUP, signal.SIGTERM, signal.SIGINT, signal.SIGUSR1
{body}
"""


def said(body: str) -> list[str]:
    done = python(PROGRAM.replace("{body}", body))
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_a_signal_that_is_sent_twice_interrupts_once() -> None:
    body = """
p.raise_interrupts(TERM, HUP)
assert not p.stop_signal_received()
try:
    send(TERM)
except KeyboardInterrupt:
    send(TERM, HUP)
    print("once", p.stop_signal_received())
time.sleep(p.REPEAT_S)
try:
    send(HUP)
except KeyboardInterrupt:
    print("again")
"""
    assert said(body) == ["once True", "again"]


def test_interrupts_are_deferred() -> None:
    body = """
p.raise_interrupts(TERM)
try:
    with p.interrupts_deferred():
        with p.interrupts_deferred():
            send(TERM)
        print("complete")
    print("not here")
except KeyboardInterrupt:
    print("interrupted")
with p.interrupts_deferred():
    print("next")
"""
    assert said(body) == ["complete", "interrupted", "next"]


@pytest.mark.parametrize("number", ["TERM", "INT"])
def test_an_interrupt_where_python_discards_exceptions_is_raised_again(number: str) -> None:
    body = f"""
class Finalized:
    def __del__(self):
        send({number})
p.raise_interrupts(TERM)
try:
    Finalized()
    print("discarded")
    wait_for_signal()
except KeyboardInterrupt:
    print("interrupted")
time.sleep(0.1)
class Failing:
    def __del__(self):
        raise ValueError("shown as ever")
Failing()
with p.stop_signals(lambda: print("stopped")):
    p.signal.setitimer(signal.ITIMER_REAL, p.RAISE_AGAIN_S)
    time.sleep(0.1)
"""
    assert said(body) == ["discarded", "interrupted", "stopped"]


def test_all_stop_signals_stop_and_ignored_ones_stay_ignored() -> None:
    body = """
signal.signal(HUP, signal.SIG_IGN)
got = []
with p.stop_signals(lambda: got.append(1)):
    send(HUP)
    assert not got
    send(INT, TERM, USR1)
p.raise_interrupts(HUP)
send(HUP)
print(len(got), signal.getsignal(TERM) is signal.SIG_DFL)
print([number.name for number in p.accepted_stop_signals()])
"""
    assert said(body) == ["3 True", "['SIGINT', 'SIGTERM', 'SIGUSR1']"]


def test_output_to_a_closed_terminal_is_discarded() -> None:
    body = """
p.raise_interrupts(HUP)
try:
    print("ready", flush=True)
    wait_for_signal()
except KeyboardInterrupt:
    print("into the void", flush=True)
print("errors are redirected", file=sys.stderr)
"""
    ours, theirs = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM.replace("{body}", body)],
        stdin=theirs,
        stdout=theirs,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # noqa: PLW1509 (one thread)
    )
    os.close(theirs)
    assert os.read(ours, 100).startswith(b"ready")
    os.close(ours)
    assert process.communicate(timeout=60)[1] == "errors are redirected\n"
    assert process.returncode == 0


def test_a_process_dies_with_its_parent_by_the_signal_that_it_chose() -> None:
    body = """
reader, writer = os.pipe()
if os.fork() == 0:
    if os.fork() == 0:
        signal.signal(USR1, lambda *_: (os.write(writer, b"x"), os._exit(0)))
        p.die_with_parent(number=USR1)
        os.write(writer, b"r")
        wait_for_signal()
    os.read(reader, 1)
    os._exit(0)
time.sleep(0.2)
os.close(writer)
print(os.read(reader, 1))
"""
    assert said(body) == ["b'x'"]
