"""Payloads of the simulated network: encoded messages, or message objects without encoding."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

from laneweave.protocol.runtime.node import Arrived, known_key, read_message
from laneweave.protocol.wire.topics import Keys

CACHE_SIZE = 4096
"""Size of the shared caches of decoded messages and of keys."""


class Parcel(bytes):
    """A message object that is sent in place of its bytes."""

    message: object
    arrived: Arrived | None
    """The event of its newest arrival, which receivers on one key share."""
    key: str
    """Key of the newest arrival."""

    def __new__(cls, message: object) -> Parcel:
        """Wrap a message."""
        parcel = super().__new__(cls)
        parcel.message, parcel.arrived, parcel.key = message, None, ""
        return parcel


class Reader:
    """Decoder of a realm's messages, which are bytes or objects."""

    def __init__(self, keys: Keys, read_payload: Callable[[bytes, type], object]) -> None:
        """Begin with empty caches; `read_payload` decodes the bytes."""
        self._known = lru_cache(maxsize=CACHE_SIZE)(partial(known_key, keys))
        # A plan has several receivers with different keys, but is decoded only once.
        read = partial(read_message, keys, decode=read_payload)
        self._read = lru_cache(maxsize=CACHE_SIZE)(read)

    def __call__(self, key: str, payload: bytes) -> Arrived:
        """Return the event of a message that arrives on a key."""
        if not isinstance(payload, Parcel):
            return self._read(key, payload)
        arrived = payload.arrived
        if arrived is None or payload.key != key:
            payload.key = key
            payload.arrived = arrived = Arrived(*self._known(key), payload.message)
        return arrived
