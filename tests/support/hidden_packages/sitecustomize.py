"""Hides packages from an interpreter: it finds this module at its start, see `support.extras`."""

import os
import sys
from importlib.machinery import ModuleSpec

HIDDEN = frozenset(os.environ["LANEWEAVE_TEST_HIDDEN"].split())


class _Hide:
    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:  # noqa: ARG004
        if name.partition(".")[0] in HIDDEN:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None


sys.meta_path.insert(0, _Hide)
