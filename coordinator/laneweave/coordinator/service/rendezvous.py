"""To which of several coordinators a request falls: rendezvous hashing.

Each weighs every name with the request; the heaviest has it. All who know the same names come to
the same conclusion. When one dies, only its requests fall to others. Where the names that are known
differ for a moment, a request may fall to two, who make the same plan, or to nobody, and is asked
again.

Thaler and Ravishankar, "Using name-based mappings to increase hit rates", IEEE/ACM Transactions on
Networking 6(1), 1998.
"""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import blake2b


def falls_to(name: str, others: Iterable[str], payload: bytes) -> bool:
    """Tell whether a request falls to `name` rather than to one of the others."""
    rivals = [other for other in others if other != name]
    if not rivals:
        return True
    digest = blake2b(payload, digest_size=16).digest()
    own = _weight(name, digest)
    return all(own > _weight(other, digest) for other in rivals)


def _weight(name: str, digest: bytes) -> tuple[bytes, str]:
    return blake2b(digest, key=name.encode(), digest_size=8).digest(), name
