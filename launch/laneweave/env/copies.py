"""Copies of a running environment, as bytes.

`pickle` alone would break three things in the roles of a run: views of arrays would no longer share
memory with their arrays, constants that are compared with `is` would become other objects, and
caches and read-only mappings cannot be pickled at all.
"""

from __future__ import annotations

import io
import pickle
import sys
from enum import Enum
from functools import _lru_cache_wrapper, lru_cache
from importlib import import_module
from itertools import count
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Reduced = Any
"""What `__reduce__` returns, or `NotImplemented`."""


def dumped(state: object) -> bytes:
    """Return a state as bytes.

    Raises:
        pickle.PicklingError, TypeError, AttributeError: a part cannot be copied.
    """
    out = io.BytesIO()
    _Pickler(out, pickle.HIGHEST_PROTOCOL).dump(state)
    return out.getvalue()


def loaded(data: bytes) -> Any:  # noqa: ANN401 (the state)
    """Return a copy of the state that `dumped` has received."""
    return pickle.loads(data)  # noqa: S301 (the caller unpickles already)


class _Pickler(pickle.Pickler):
    def __init__(self, out: io.BytesIO, protocol: int) -> None:
        super().__init__(out, protocol)
        self._constants = _constants()

    def reducer_override(self, obj: Any) -> Reduced:  # noqa: ANN401 (any object)
        """Return how to restore an object; `NotImplemented`: as `pickle` does."""
        if isinstance(obj, np.ndarray):
            owner = _owner(obj)
            if owner is not obj and owner.flags.forc:
                first = _address(obj) - _address(owner)
                return _view, (owner, obj.shape, obj.dtype, first, obj.strides)
        elif id(obj) in self._constants:
            return _constant, self._constants[id(obj)]
        elif isinstance(obj, MappingProxyType):
            return _read_only, (dict(obj),)
        elif isinstance(obj, count):
            # From Python 3.14 on, it cannot be pickled; only its text has the next value.
            return count, (int(repr(obj).removeprefix("count(").removesuffix(")")),)
        elif isinstance(obj, _lru_cache_wrapper) and not _is_global(obj):
            return _empty_cache, (obj.__wrapped__, obj.cache_parameters()["maxsize"])
        return NotImplemented


def _constants() -> dict[int, tuple[str, str]]:
    """Return module and name of each constant of the project, by its `id`."""
    return {
        id(value): (module, name)
        for module, content in tuple(sys.modules.items())
        if module.startswith("laneweave.")
        for name, value in vars(content).items()
        if name.isupper()
        and type(value).__module__.startswith("laneweave.")
        and not isinstance(value, Enum)
    }


def _constant(module: str, name: str) -> object:
    return getattr(import_module(module), name)


def _owner(array: NDArray[Any]) -> NDArray[Any]:
    """Return the array of which another one is a view, however many views are in between."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def _address(array: NDArray[Any]) -> int:
    """Return the address of the first element."""
    return int(array.__array_interface__["data"][0])


def _view(
    owner: NDArray[Any],
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    first: int,
    strides: tuple[int, ...],
) -> NDArray[Any]:
    """Return a view of an array that begins at its byte `first`."""
    return np.ndarray(shape, dtype, owner.ravel("K"), first, strides)


def _read_only(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(values)


def _is_global(cached: _lru_cache_wrapper[Any]) -> bool:
    """Return whether a cached function is one of its module, which `pickle` finds by name."""
    module = sys.modules.get(getattr(cached, "__module__", None) or "")
    return getattr(module, getattr(cached, "__qualname__", ""), None) is cached


def _empty_cache(function: Any, maxsize: int | None) -> object:  # noqa: ANN401 (a callable)
    return lru_cache(maxsize)(function)
