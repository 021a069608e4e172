"""Messages of earlier releases, kept as files: this release reads them.

`releases/` has the messages of the first state in which messages are addressed to processes, which
gave them the version 3.
"""

from __future__ import annotations

import json
from pathlib import Path

import msgpack
import pytest

from laneweave.protocol.wire.codec import KINDS, decode, encode
from support.wire_samples import different, filled

RELEASES = sorted((Path(__file__).parent / "releases").glob("*.json"))


@pytest.mark.parametrize("release", RELEASES, ids=lambda path: path.stem)
def test_messages_of_an_earlier_release_are_read(release: Path) -> None:
    """Each field has the value that was sent; those that are new have their defaults."""
    kept = json.loads(release.read_text(encoding="utf-8"))
    assert kept
    for kind, text in kept.items():
        payload = bytes.fromhex(text)
        message = decode(payload, KINDS[kind])
        (_, _, then), (_, _, now) = msgpack.unpackb(payload), msgpack.unpackb(encode(message))
        assert now[: len(then)] == then


def test_this_release_sends_messages_that_the_one_before_reads() -> None:
    """New fields come last: the release before skips them, and counts them."""
    kept = json.loads(RELEASES[-1].read_text(encoding="utf-8"))
    for kind, text in kept.items():
        (*_, then), (*_, now) = (
            msgpack.unpackb(payload)
            for payload in (bytes.fromhex(text), encode(filled(KINDS[kind], different())))
        )
        assert now[: len(then)] == then
