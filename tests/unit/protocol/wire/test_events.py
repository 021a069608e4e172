"""Every kind of event, and every field of its data, is described."""

from __future__ import annotations

from laneweave.protocol.wire import events


def test_every_kind_and_field_is_described() -> None:
    kinds = {
        value for name, value in vars(events).items() if name.isupper() and isinstance(value, str)
    }
    assert events.FIELDS.keys() == kinds
    named = {name for names in events.FIELDS.values() for name in names}
    assert named | set(events.COMMON_FIELDS) == events.MEANINGS.keys()
