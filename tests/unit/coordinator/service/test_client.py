"""What a client makes of each answer, and of none: plan, another attempt, or one clear error."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from itertools import pairwise
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import plan
from laneweave.coordinator.service.client import (
    FIRST_PAUSE_S,
    LONGEST_PAUSE_S,
    DeadlinePassedError,
    PendingRequest,
    PlanError,
    PlanningFailedError,
    RequestCancelledError,
    RequestRefusedError,
    ServiceOverloadedError,
    ServiceUnavailableError,
)
from laneweave.protocol.runtime.queries import (
    CANCELLED,
    FAILED,
    INVALID,
    JSON,
    LATE,
    MSGPACK,
    OVERLOADED,
    Format,
)
from laneweave.protocol.runtime.transport import Answer

REQUEST = PlanRequest.from_dict(
    {
        "schema": "laneweave.plan.request/1",
        "id": "r",
        "grid": {"columns": 3, "lanes": 2},
        "vehicles": [{"id": "a", "cell": [0, 0], "lane": 1}],
        "targets": [[1, 1], [2, 0]],
    }
)
PLAN = plan(REQUEST)
START_S = 100.0
FORMATS = pytest.mark.parametrize("form", [JSON, MSGPACK], ids=["JSON", "MessagePack"])


def inquiry(timeout_s: float = 10.0) -> PendingRequest:
    payload = JSON.write(REQUEST.to_dict())
    return PendingRequest(payload, timeout_s, START_S, "tcp/router:7447, realm default,")


def refusal(**data: object) -> Answer:
    return Answer(json.dumps(data).encode(), False, JSON.encoding)


OVERLOAD = refusal(field="", message="ask again later", code=OVERLOADED)


# --- answers ----------------------------------------------------------------------------------


@FORMATS
@pytest.mark.parametrize("told", [True, False])
def test_a_plan_is_the_plan(form: Format, *, told: bool) -> None:
    encoding = form.encoding if told else "zenoh/bytes"
    answer = Answer(form.write(PLAN.to_dict()), True, encoding)
    assert inquiry().after(answer, START_S) == PLAN


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (INVALID, RequestRefusedError),
        (LATE, DeadlinePassedError),
        (CANCELLED, RequestCancelledError),
        (FAILED, PlanningFailedError),
        ("of tomorrow", PlanningFailedError),
    ],
)
@FORMATS
def test_a_refusal_is_an_error_of_its_own_kind(
    form: Format, code: str, kind: type[PlanError]
) -> None:
    data = {"field": "mode", "message": "mode: got 3; allowed: 1 or 2", "code": code}
    with pytest.raises(kind, match=r"^mode: got 3; allowed: 1 or 2$") as caught:
        inquiry().after(Answer(form.write(data), False, form.encoding), START_S)
    assert type(caught.value) is kind
    if isinstance(caught.value, RequestRefusedError):
        assert caught.value.field == "mode"


def test_a_refusal_without_a_code_is_classified_by_its_field() -> None:
    with pytest.raises(RequestRefusedError, match="wrong"):
        inquiry().after(refusal(field="mode", message="wrong"), START_S)
    with pytest.raises(PlanningFailedError, match="broken"):
        inquiry().after(refusal(field="", message="broken"), START_S)
    with pytest.raises(PlanningFailedError, match="broken"):
        inquiry().after(refusal(message="broken"), START_S)


def test_a_message_is_always_one_line() -> None:
    with pytest.raises(RequestRefusedError) as caught:
        inquiry().after(refusal(field="a\nb", message="one\r\ntwo\x1b[2J" + 9999 * "x"), START_S)
    assert str(caught.value).startswith("one two [2Jx")
    assert len(str(caught.value)) <= 500
    assert caught.value.field == "a b"


# --- no answer, and too much to do ------------------------------------------------------------


@pytest.mark.parametrize("answer", [None, OVERLOAD], ids=["silence", "overload"])
def test_pauses_grow_and_are_bounded(answer: Answer | None) -> None:
    asked = inquiry(1000.0)
    pauses_s = []
    for _ in range(12):
        again = asked.after(answer, START_S)
        assert isinstance(again, float)
        pauses_s.append(again)
    assert pauses_s[0] == FIRST_PAUSE_S
    assert pauses_s == sorted(pauses_s)
    assert all(b <= 2 * a for a, b in pairwise(pauses_s))
    assert pauses_s[-1] == LONGEST_PAUSE_S


def after_pauses(
    asked: PendingRequest, answers: list[Answer | None], attempt_s: float = 0.001
) -> float:
    """Ask as often as it is worth; returns when it was given up. The last answer is repeated."""
    now_s = START_S
    for number in range(10_000):
        now_s += attempt_s
        try:
            again = asked.after(answers[min(number, len(answers) - 1)], now_s)
        except PlanError as error:
            error.add_note(f"at {now_s}")
            raise
        assert isinstance(again, float)
        now_s += again
    raise AssertionError("asked for ever")


def given_up_s(error: BaseException) -> float:
    return float(error.__notes__[0].removeprefix("at ")) - START_S


@pytest.mark.parametrize("answers", [[None], [*4 * [None], OVERLOAD, None]])
@pytest.mark.parametrize("timeout_s", [2.0, 20.0, 60.0])
def test_a_client_waits_for_a_coordinator_until_its_own_deadline(
    answers: list[Answer | None], timeout_s: float
) -> None:
    with pytest.raises(ServiceUnavailableError) as caught:
        after_pauses(inquiry(timeout_s), answers)
    assert timeout_s - FIRST_PAUSE_S <= given_up_s(caught.value) <= timeout_s + 0.002
    assert str(caught.value) == (
        f"no coordinator has answered at tcp/router:7447, realm default, within {timeout_s:g} s"
    )


def test_a_coordinator_that_starts_shortly_before_the_deadline_is_asked() -> None:
    asked, now_s = inquiry(20.0), START_S
    attempts_s = []
    with suppress(ServiceUnavailableError):
        while True:
            attempts_s.append(now_s)
            pause_s = asked.after(None, now_s)
            assert isinstance(pause_s, float)
            now_s += pause_s
    assert attempts_s[-1] == pytest.approx(START_S + 20.0 - FIRST_PAUSE_S)
    assert max(after - before for before, after in pairwise(attempts_s)) <= LONGEST_PAUSE_S + 1e-9


def test_a_timeout_says_what_was_awaited() -> None:
    assert str(inquiry(20.0).unanswered) == (
        "no plan from tcp/router:7447, realm default, within 20 s"
    )


@pytest.mark.parametrize(
    ("answer", "kind"), [(None, ServiceUnavailableError), (OVERLOAD, ServiceOverloadedError)]
)
@pytest.mark.parametrize("timeout_s", [0.0, 0.01, 0.5, 2.0])
def test_no_pause_goes_beyond_the_timeout(
    answer: Answer | None, kind: type[PlanError], timeout_s: float
) -> None:
    with pytest.raises(kind) as caught:
        after_pauses(inquiry(timeout_s), [answer])
    assert given_up_s(caught.value) <= timeout_s + 0.002


def test_an_overload_is_waited_out_for_as_long_as_was_asked() -> None:
    with pytest.raises(ServiceOverloadedError, match="ask again later") as caught:
        after_pauses(inquiry(60.0), [OVERLOAD])
    assert given_up_s(caught.value) > 60.0 - 2 * LONGEST_PAUSE_S


def test_a_coordinator_may_ask_for_a_longer_pause() -> None:
    asked = inquiry()
    overload = refusal(field="", message="later", code=OVERLOADED, retry_after_s=3.0)
    assert asked.after(overload, START_S) == 3.0
    assert asked.after(OVERLOAD, START_S) == 2 * FIRST_PAUSE_S
    with pytest.raises(ServiceOverloadedError):
        asked.after(overload, START_S + 7.5)


@pytest.mark.parametrize("advice", [0, -1.0, math.inf, math.nan, "soon", None])
def test_strange_advice_is_ignored(advice: object) -> None:
    overload = refusal(field="", message="later", code=OVERLOADED, retry_after_s=advice)
    assert inquiry().after(overload, START_S) == FIRST_PAUSE_S


def test_each_attempt_asks_the_same() -> None:
    asked = inquiry()
    before = asked.payload
    asked.after(None, START_S)
    asked.after(OVERLOAD, START_S)
    assert asked.payload == before
    assert PlanRequest.from_dict(json.loads(before)) == REQUEST


def test_what_is_left_of_the_time() -> None:
    assert inquiry(10.0).left_s(START_S + 4.0) == 6.0


# --- malformed answers ------------------------------------------------------------------------


def nonsense() -> st.SearchStrategy[Any]:
    leaves = (
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9)
        | st.just(10**400)
    )  # fmt: skip
    return st.recursive(leaves, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(
        st.text(max_size=5), inner, max_size=4
    ))  # fmt: skip


def check(payload: bytes, encoding: str, *, ok: bool) -> None:
    found: PlanResponse | float | PlanError
    try:
        found = inquiry().after(Answer(payload, ok, encoding), START_S)
    except PlanError as error:
        found = error
    if isinstance(found, PlanError):
        assert type(found) is PlanningFailedError or not ok
        assert "\n" not in str(found)
    else:
        assert isinstance(found, PlanResponse if ok else float)


ENCODINGS = st.sampled_from([JSON.encoding, MSGPACK.encoding, "zenoh/bytes", ""])


@given(st.binary(max_size=200), ENCODINGS, st.booleans())
def test_whatever_bytes_come_there_is_one_kind_of_error(
    payload: bytes,
    encoding: str,
    ok: bool,
) -> None:
    check(payload, encoding, ok=ok)


@given(st.sampled_from(sorted(PLAN.to_dict())), nonsense(), st.sampled_from([JSON, MSGPACK]))
def test_whatever_a_plan_holds_there_is_one_kind_of_error(
    name: str,
    value: object,
    form: Format,
) -> None:
    try:
        payload = form.write(PLAN.to_dict() | {name: value})
    except (OverflowError, UnicodeError):
        return  # MessagePack does not carry it
    check(payload, form.encoding, ok=True)


@given(st.dictionaries(st.sampled_from(["field", "message", "code", "x"]), nonsense()))
def test_whatever_a_refusal_holds_there_is_one_kind_of_error(data: dict[str, Any]) -> None:
    check(json.dumps(data).encode(), JSON.encoding, ok=False)


@pytest.mark.parametrize(
    "payload",
    [
        b"{" * 100_000,
        b"[" * 100_000,
        b"\x91" * 100_000,
        b'{"a":' * 100_000,
        b"9" * 10_000,
        json.dumps(PLAN.to_dict() | {"solve_ms": float("nan")}).encode(),
        json.dumps(PLAN.to_dict() | {"solve_ms": -1.0}).encode(),
        json.dumps(PLAN.to_dict() | {"solve_ms": 10**400}).encode(),
        msgpack.packb({1: 2}),
    ],
    ids=["open", "deep list", "deep MessagePack", "deep", "digits", "NaN", "negative", "huge",
         "number as key"],
)  # fmt: skip
def test_an_answer_that_is_no_plan(payload: bytes) -> None:
    with pytest.raises(PlanningFailedError, match="the answer is not a plan") as caught:
        inquiry().after(Answer(payload, True, ""), START_S)
    assert "request" not in str(caught.value)
    if not payload.startswith(b'{"schema'):
        with pytest.raises(PlanningFailedError, match="the answer is not an error reply"):
            inquiry().after(Answer(payload, False, ""), START_S)
