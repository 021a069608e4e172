"""What happened in a simulated network, boiled down to a digest: are two runs the same?"""

from __future__ import annotations

from hashlib import blake2b

from laneweave.protocol.runtime.node import Computed
from laneweave.protocol.runtime.transport import Question, Received, TokenDown, TokenUp
from laneweave.protocol.transports.simulated.virtual_time import Item


class TraceDigest:
    """A trace that keeps only a running hash of everything that nodes are handed, in order.

    The result of a computation is left out, since it may be any object; what a core makes of it
    shows in the messages that follow.
    """

    def __init__(self) -> None:
        """Begin with nothing."""
        self.events = 0
        self._hash = blake2b(digest_size=16)

    def __call__(self, now_s: float, name: str, item: Item) -> None:
        """Take in one event."""
        self.events += 1
        about: tuple[object, ...] = ()
        payload = b""
        match item:
            case Received(key, payload):
                about = (key,)
            case TokenUp(key) | TokenDown(key):
                about = (key,)
            case Question(key, payload, token):
                about = (key, token)
            case Computed(job, _, error):
                about = (job, error)
            case _:
                pass
        # The length keeps the payload's bytes apart from what follows them.
        line = repr((now_s, name, type(item).__name__, *about, len(payload)))
        self._hash.update(line.encode())
        self._hash.update(payload)

    def hexdigest(self) -> str:
        """Return the digest of everything so far: 32 hexadecimal digits."""
        return self._hash.hexdigest()
