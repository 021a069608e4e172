"""Shrinking: the smallest story, among those tried, that still fails in the same way."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from attrs import evolve

from laneweave.launch.fault_search.checks.violations import Violation
from laneweave.launch.fault_search.events.faults import LAST_S
from laneweave.launch.fault_search.events.lasting_faults import HEALTHY, LastingFaults
from laneweave.launch.fault_search.story import Story
from laneweave.protocol.wire.messages import Name

MAX_RUNS = 300
"""Maximum number of runs for shrinking one story."""

Check = Callable[[Story], tuple[Violation, ...]]
"""Runs a story and returns its violations."""


def shrink(story: Story, check: Check, max_runs: int = MAX_RUNS) -> Story:
    """Return a story with fewer vehicles, events and faults that fails in the same way.

    Args:
        story: story that fails.
        check: runs a story.
        max_runs: maximum number of runs.
    """
    violations = check(story)
    if not violations:
        return story
    kind, runs = violations[0].kind, 1
    shrinking = True
    while shrinking:
        shrinking = False
        for smaller in _smaller(story, violations[0]):
            if runs >= max_runs:
                return story
            runs += 1
            found = check(smaller)
            if found and found[0].kind == kind:
                story, violations, shrinking = smaller, found, True
                break
    return story


def _smaller(story: Story, violation: Violation) -> Iterator[Story]:
    """Yield smaller stories, those without most parts first."""
    yield from _shorter(story, violation)
    count = len(story.events)
    size = count
    while size >= 1:
        for first in range(0, count, size):
            yield evolve(story, events=story.events[:first] + story.events[first + size :])
        size //= 2
    if len(story.setup.visits) > 1:
        yield from (_without(visit.vehicle, story) for visit in story.setup.visits)
    for index in range(1, len(story.preferences) - 1):
        kept_changes = story.preferences[:index] + story.preferences[index + 1 :]
        yield evolve(story, preferences=kept_changes)
    for lasting in _calmer(story.setup.lasting):
        yield evolve(story, setup=evolve(story.setup, lasting=lasting))


def _without(vehicle: Name, story: Story) -> Story:
    """Return the story without a vehicle."""
    visits = tuple(visit for visit in story.setup.visits if visit.vehicle != vehicle)
    preferences = tuple(
        evolve(change, lanes={name: lane for name, lane in change.lanes.items() if name != vehicle})
        for change in story.preferences
    )
    return evolve(story, setup=evolve(story.setup, visits=visits), preferences=preferences)


def _shorter(story: Story, violation: Violation) -> Iterator[Story]:
    """Yield the story without what comes after the violation."""
    end_s = violation.t_s + LAST_S
    if violation.kind == "stuck" or end_s >= story.fault_s:
        return
    yield evolve(
        story,
        setup=evolve(story.setup, lasting=evolve(story.setup.lasting, fault_s=end_s)),
        events=tuple(event for event in story.events if event.t_s < end_s),
        preferences=tuple(change for change in story.preferences if change.t_s < end_s),
    )


def _calmer(lasting: LastingFaults) -> Iterator[LastingFaults]:
    """Yield the lasting faults without one of them."""
    before = lasting.conditions
    calmer = [
        evolve(lasting, command_loss=0.0),
        evolve(lasting, late_commands=0.0),
        evolve(lasting, slow_moves=0.0),
        evolve(lasting, wrong_clocks=False),
        evolve(lasting, conditions=evolve(before, loss=0.0)),
        evolve(lasting, conditions=evolve(before, duplication=0.0)),
        evolve(lasting, conditions=evolve(before, jitter_s=HEALTHY.jitter_s)),
        evolve(lasting, conditions=evolve(before, compute_jitter_s=0.0)),
        evolve(lasting, conditions=evolve(before, compute_failure=0.0)),
    ]
    return (each for each in calmer if each != lasting)
