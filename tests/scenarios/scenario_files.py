"""Runs text scenarios: hand-written schedules of messages for the real protocol code.

A scenario is a text file. `#` begins a comment, and the first lines say what it shows. Every other
line is a command, and the lines below it that begin with `=>` are exactly what must happen.
Nothing happens by itself: a message that is not delivered is lost, one that is delivered twice is
duplicated, one delivered later is late. No two vehicles may ever occupy
the same cell, and a moving vehicle occupies the cell that it leaves, too.

Cells are written column,lane. Columns count backwards from the front: formation 0 owns the block of
columns 0 to -3, formation 1 the columns -4 to -7, and so on; there are lanes 0 to 2. Ballots are
written term/coordinator/incarnation/seq, the higher one wins. Time is in seconds.

**Vehicles.** Each has a body, a motion controller, and a process that acts for it.

| command | what it does |
|---|---|
| `vehicle A at -1,1 wants 2` | a vehicle in -1,1 that prefers lane 2; its agent A is in charge |
| `A ticks` | A senses its vehicle, decides, and commands its motion controller |
| `A arrives` | its body has reached the cell that its controller makes for; A ticks |
| `A gets PREPARE 1/L1/1/1` | mail to A arrives: now, late, or again (`PLAN` likewise) |
| `B hears A` | the state that A has shown last arrives |
| `note A as x`, then `B hears x` | the state that A showed then arrives late |
| `A restarts` | another process is its agent now, and in charge; the motion controller goes on |
| `agent A2 for A` | there is a second agent of A: it is not in charge before it has claimed A |
| `caretaker K for A` | the caretaker of A takes charge, because its agent died or fell silent |
| `A senses`, `A commands` | the two halves of a tick: in between, the COMMAND is under way |
| `body of A arrives` | the same as `A arrives` when no agent notices |
| `body of A falls back to -1,0` | it has braked, and is in another cell than it should hold |
| `A leaves` | the vehicle has left the road |
| `show A` | what A knows |

**Leaders.** A leader has been elected and takes one formation over; the scenario plans for it.

| command | what it does |
|---|---|
| `leader L1 term 1 leads A B` | L1 takes over the formations in whose blocks A and B entered |
| `clock 4.0` | it is that late; step n of the scenario's plans may begin at n seconds |
| `L1 hears A` | the state that A has shown last arrives |
| `L1 sends` | its timers run; what it sends is listed and goes into the mail |
| `L1 plans A@0>0,2 B@1>0,1` | planning succeeds: A moves in step 0 to 0,2, B in step 1 to 0,1 |
| `L1 plans A:0,1@0>0,2` | the same by a planner that takes A to be in 0,1 |
| `L1 plans A@0>-4,0 in blocks 0 1` | the same by one that claims the blocks of formations 0 and 1 |
| `L1 plans C@0>-4,1 in blocks 1 for C` | the same by one that plans for C and block 1 only |
| `L1 fails to plan` | planning fails |
| `L1 census A B` | the census shows who is on the road |
| `L1 restarts` | it is another process now, elected anew for the same vehicles |
| `L1 collects promises` | in short: all are heard, get the PREPARE, and are heard again |
| `L1 brings A@0>0,2 into force` | in short: it plans, all get the PLAN and hear each other |

For two formations `collects promises` includes the ticks in which the controllers join them.

**Candidates.** A candidate is a whole coordinator, with election, blocks, joint ballots and the
real planner. It understands what a leader does, but it plans itself:

| command | what it does |
|---|---|
| `candidate c1` | a process has just started |
| `c2 hears c1` | the heartbeat that c1 has sent last arrives (`note c1 as x` works, too) |
| `c2 sees c1 appear`, `c2 sees c1 vanish` | c1 has connected; its connection has closed |
| `c1 loses the router`, `c1 finds the router` | its own connection |
| `c1 plans` | the planner finishes what c1 has ordered first |
| `c1 brings its plan into force` | in short: it plans, all get the PLAN and hear each other |

Scenarios of the rolling operation have names that begin with `rolling_`; `scenario_rolling` lists
their further commands.
"""

from __future__ import annotations

from pathlib import Path

from attrs import frozen

from laneweave.coordinator.formations.leader import LEADER_RULES
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from scenarios.scenario_rolling import RollingRunner, is_rolling
from scenarios.scenario_runner import Runner
from scenarios.scenario_text import CollisionError, ScenarioError


@frozen
class Line:
    """One command of a scenario with what it must lead to."""

    number: int
    command: str
    expected: tuple[str, ...]


def read_scenario(path: Path) -> list[Line]:
    """Read a scenario's lines.

    Raises:
        ScenarioError: an expectation has no command above it.
    """
    lines: list[Line] = []
    for number, raw in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        text = raw.split("#")[0].strip()
        if text.startswith("=>"):
            if not lines:
                raise ScenarioError(f"{path.name}:{number}: `=>` without a command")
            last = lines.pop()
            lines.append(Line(last.number, last.command, (*last.expected, text[2:].strip())))
        elif text:
            lines.append(Line(number, text, ()))
    return lines


def runner_of(
    path: Path, vehicle_rules: RuleBook = VEHICLE_RULES, leader_rules: RuleBook = LEADER_RULES
) -> Runner:
    """Return an empty road for a scenario; other rules plant a bug."""
    if is_rolling(path.stem):
        return RollingRunner(vehicle_rules, leader_rules)
    return Runner(vehicle_rules, leader_rules)


def check_scenario(path: Path, runner: Runner | None = None) -> None:
    """Run a scenario.

    Args:
        path: the scenario.
        runner: an empty road; None: one with the rules as they are.

    Raises:
        ScenarioError: it went otherwise; the message names the line.
    """
    runner = runner or runner_of(path)
    for line in read_scenario(path):
        try:
            happened = tuple(runner.run(line.command))
        except ScenarioError as error:
            raise type(error)(f"{path.name}:{line.number}: {error}") from error
        if happened != line.expected:
            happened_lines = "".join(f"\n  => {each}" for each in happened) or "\n  nothing"
            raise ScenarioError(f"{path.name}:{line.number}: {line.command}{happened_lines}")


def ends_in_collision(path: Path, runner: Runner) -> bool:
    """Run a scenario to its end even if it fails, and return whether vehicles collide."""
    for line in read_scenario(path):
        try:
            for _ in runner.run(line.command):
                pass
        except CollisionError:
            return True
        except ScenarioError:
            continue
    return False
