"""Malformed plan requests, made from valid ones: any node of the tree, any byte, any encoding."""

from __future__ import annotations

import copy
import json
import math
import random
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import msgpack
from attrs import frozen

from laneweave.protocol.runtime.queries import CODES, FAILED, OVERLOADED
from laneweave.protocol.runtime.transport import Answer
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.topics import SERVICE, Keys

IN_FLIGHT = 48
"""Below the limit of a service, which stays out of this."""
ANSWER_S = 120.0

Tree = dict[str, Any]

REQUESTS: tuple[Tree, ...] = (
    {
        "schema": "laneweave.plan.request/1",
        "grid": {"columns": 3, "lanes": 2, "blocked": [[2, 1]]},
        "mode": 1,
        "conflicts": ["node", "edge", "special-1"],
        "vehicles": [{"id": "a", "cell": [0, 0], "lane": 1}, {"id": "b", "cell": [1, 1]}],
        "targets": [[1, 1], [2, 0]],
        "deadline_s": 2.0,
    },
    {
        "schema": "laneweave.plan.request/1",
        "id": "one of many",
        "grid": {"columns": 4, "lanes": 2},
        "mode": 2,
        "conflicts": ["node", "geometric"],
        "geometry": {"length_m": 4.5},
        "vehicles": [
            {"id": "a", "cell": [0, 0], "eligible": [0, 1]},
            {"id": "b", "cell": [1, 1], "lane": 0},
        ],
        "targets": [[2, 0], [3, 1], [3, 0]],
        "deadline_s": 2,
    },
)
WILD: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 3, 7, 2**31, 2**63 - 1, -(2**63), 0.0, -0.0, 1.5, 1e-300,
    1e308, math.nan, math.inf, -math.inf, "", "a", "1", "\x00", "\n", "\u2028", "z" * 300, "node",
    [], [[]], [0], [0, 0], [0, 0, 0], [9, 9], [-1, 0], [0.0, 1.0], ["0", "1"], [True, False],
    [None, None], {}, {"": 0}, {"\n": 0}, {"id": "a"}, [{}], [[0, 0], [0, 0]],
)  # fmt: skip
WILD_JSON: tuple[Any, ...] = (10**30, 10**400, "\ud800", {"\udfff": 1})
"""What MessagePack cannot carry."""
KEYS = ("", "x", "id", "lane", "eligible", "cell", "Columns", "\n", "k" * 300)
JSON, MSGPACK = "application/json", "application/msgpack"
ENCODINGS = (
    "", JSON, MSGPACK, "application/json;charset=utf-8", "text/plain", "zenoh/bytes", "zenoh/int",
    "application/cbor",
)  # fmt: skip


@frozen
class Mutant:
    """What is asked."""

    payload: bytes
    encoding: str
    kind: str


def mutants(seed: int, count: int) -> Iterator[Mutant]:
    """Yield malformed requests, and a few that are still valid; equal for equal seeds."""
    chance = random.Random(seed)
    kinds: tuple[Callable[[random.Random], Mutant], ...] = (
        *4 * (_of_tree,), _of_bytes, _mislabelled, _same_id, _garbage,
    )  # fmt: skip
    for number in range(count):
        if number % 500 == 17:
            yield from _monsters(chance)
        yield chance.choice(kinds)(chance)


def _of_tree(chance: random.Random) -> Mutant:
    form = chance.choice((JSON, MSGPACK))
    tree = copy.deepcopy(chance.choice(REQUESTS))
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        _change(tree, chance, WILD + WILD_JSON if form == JSON else WILD)
    return Mutant(_write(tree, form), chance.choice(("", form)), "tree")


def _of_bytes(chance: random.Random) -> Mutant:
    form = chance.choice((JSON, MSGPACK))
    payload = bytearray(_write(chance.choice(REQUESTS), form))
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(len(payload) or 1)
        match chance.randrange(4):
            case 0 if payload:
                payload[at] ^= 1 << chance.randrange(8)
            case 1:
                payload[at:at] = chance.randbytes(chance.randint(1, 4))
            case 2:
                del payload[at : at + chance.randint(1, 4)]
            case 3:
                del payload[at:]
    return Mutant(bytes(payload), chance.choice(("", form)), "bytes")


def _mislabelled(chance: random.Random) -> Mutant:
    form = chance.choice((JSON, MSGPACK))
    return Mutant(_write(chance.choice(REQUESTS), form), chance.choice(ENCODINGS), "mislabelled")


def _same_id(chance: random.Random) -> Mutant:
    tree = copy.deepcopy(REQUESTS[1])
    tree["deadline_s"] = chance.uniform(1.5, 2.5)
    return Mutant(_write(tree, JSON), JSON, "same id")


def _garbage(chance: random.Random) -> Mutant:
    garbage = chance.randbytes(chance.choice((0, 1, 2, 30, 3000)))
    return Mutant(chance.choice((b"", b"{", b'{"schema":')) + garbage, "", "garbage")


def _monsters(chance: random.Random) -> Iterator[Mutant]:
    """Yield what is giant, or deep."""
    many = copy.deepcopy(REQUESTS[0])
    many[chance.choice(("targets", "vehicles", "conflicts"))] *= 3000
    blocked = copy.deepcopy(REQUESTS[0])
    blocked["grid"] = {"columns": 1000, "lanes": 16, "blocked": [[5, 5]] * 15_000}
    for tree in (many, blocked):
        yield Mutant(_write(tree, chance.choice((JSON, MSGPACK))), "", "giant")
    for size in (262_145, 1_100_000):
        start = chance.choice((b"{", b"\x81", b'{"schema": "'))
        yield Mutant(start + b" " * size, chance.choice(("", JSON)), "giant")
    for bracket in (b'{"grid":', b"[", b"\x91", b"\x81\xa1a"):
        yield Mutant(bracket * 30_000, chance.choice(("", JSON, MSGPACK)), "deep")
    yield Mutant(b'{"mode": ' + b"9" * 9000 + b"}", JSON, "giant")
    deep: Any = 1
    for _ in range(200):
        deep = {"grid": [deep]}
    yield Mutant(_write(REQUESTS[0] | {"grid": deep}, chance.choice((JSON, MSGPACK))), "", "deep")


def _write(tree: Tree, form: str) -> bytes:
    if form == JSON:
        return json.dumps(tree).encode()
    packed = msgpack.packb(tree)
    assert isinstance(packed, bytes)
    return packed


def _change(tree: Tree, chance: random.Random, wild: tuple[Any, ...]) -> None:
    """Change one place of a tree."""
    holder, key = chance.choice(list(_places(tree)))
    match chance.randrange(6):
        case 0 | 1 | 2:
            holder[key] = copy.deepcopy(chance.choice(wild))
        case 3:
            del holder[key]
        case 4 if isinstance(holder, dict):
            holder[chance.choice(KEYS)] = copy.deepcopy(chance.choice(wild))
        case 4:
            holder.append(copy.deepcopy(holder[key]))
        case 5:
            other_holder, other_key = chance.choice(list(_places(tree)))
            holder[key] = copy.deepcopy(other_holder[other_key])


def _places(node: Any) -> Iterator[tuple[Any, Any]]:  # noqa: ANN401 (JSON)
    items: Any = ()
    if isinstance(node, dict):
        items = list(node.items())
    elif isinstance(node, list):
        items = list(enumerate(node))
    for key, value in items:
        yield node, key
        yield from _places(value)


# --- what becomes of them ---------------------------------------------------------------------


def verdict(mutant: Mutant, answer: Answer | None) -> str:
    """Return what a mutant was answered, which must be a plan or an error that names the field."""
    said = f"{mutant.kind} {mutant.encoding!r} {mutant.payload[:300]!r}: {answer}"
    assert answer is not None, f"not answered: {said}"
    unpack = json.loads if answer.encoding.startswith("application/json") else msgpack.unpackb
    data = unpack(answer.payload)
    if answer.ok:
        assert data["schema"] == "laneweave.plan.response/1", said
        return str(data["status"])
    assert set(data) == {"field", "message", "code"}, said
    assert data["code"] in CODES, said
    assert data["code"] not in (FAILED, OVERLOADED), said
    assert data["field"], said
    assert data["message"].isprintable(), said
    assert 10 < len(data["message"]) < 800, said
    return str(data["code"])


def ask_all(access: Access, asked: Iterator[Mutant]) -> Counter[str]:
    """Ask many at a time; returns how often what was answered."""
    key = Keys(access.realm).key(SERVICE)
    verdicts: Counter[str] = Counter()
    waiting: deque[tuple[Mutant, Future[Answer | None]]] = deque()
    transport = ZenohTransport(access, lambda _: None)
    try:
        for mutant in asked:
            if len(waiting) == IN_FLIGHT:
                first, answer = waiting.popleft()
                verdicts[verdict(first, answer.result(ANSWER_S))] += 1
            asking = transport.query(key, mutant.payload, ANSWER_S, mutant.encoding)
            waiting.append((mutant, asking))
        for mutant, answer in waiting:
            verdicts[verdict(mutant, answer.result(ANSWER_S))] += 1
    finally:
        transport.close()
    return verdicts
