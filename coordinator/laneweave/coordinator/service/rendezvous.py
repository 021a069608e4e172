"""Rendezvous hashing: assigns each request to one of several coordinators.

Each coordinator hashes every name with the request; the highest hash wins. Coordinators that know
the same names agree. When one exits, only its requests are reassigned. While their known names
differ, a request may be assigned to two coordinators, which make the same plan, or to none, so that
the client sends it again.

Thaler and Ravishankar, "Using name-based mappings to increase hit rates", IEEE/ACM Transactions on
Networking 6(1), 1998.
"""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import blake2b


def is_assigned_to(name: str, others: Iterable[str], payload: bytes) -> bool:
    """Return whether a request is assigned to `name` rather than to one of the others."""
    rivals = [other for other in others if other != name]
    if not rivals:
        return True
    digest = blake2b(payload, digest_size=16).digest()
    own = _weight(name, digest)
    return all(own > _weight(other, digest) for other in rivals)


def _weight(name: str, digest: bytes) -> tuple[bytes, str]:
    return blake2b(digest, key=name.encode(), digest_size=8).digest(), name
