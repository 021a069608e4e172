"""Frozen classes whose objects are created by the million: frozen for type checkers only.

attrs assigns the fields of a frozen object through `object.__setattr__`, which takes four times as
long: a fifth of the CPU time of a simulated run. Type checkers reject assignments to fields of
these classes as they do for `frozen`; at run time nothing does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from attrs import frozen as quick_frozen
else:
    from functools import partial

    from attrs import define, setters

    quick_frozen = partial(define, unsafe_hash=True, on_setattr=setters.NO_OP)

__all__ = ("quick_frozen",)
