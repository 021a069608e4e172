"""Input that must be refused."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from laneweave.protocol.errors import BadInputError


def refusal(call: Callable[..., object], *arguments: object, **named: object) -> BadInputError:
    """Return the error of a call that must refuse its input, in one readable line."""
    with pytest.raises(BadInputError) as caught:
        call(*arguments, **named)
    line = str(caught.value)
    assert len(line.splitlines()) == 1
    assert line.isprintable()
    assert len(line) < 800
    assert "; allowed: " in line
    assert line.startswith(re.split(r"[^!-~]", caught.value.field)[0][:100])
    for internal in ("object has no", "not iterable", "argument of type", "unhashable"):
        assert internal not in line
    return caught.value
