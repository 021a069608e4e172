"""Tracks of vehicles, made by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from laneweave.launch.recordings.trajectories import Tracks


def make_tracks(t_s: ArrayLike, count: int, **values: Sequence[ArrayLike]) -> Tracks:
    """Return tracks of vehicles v0, v1, ... that are on the road at the same times.

    Args:
        t_s: the times.
        count: number of vehicles.
        **values: for a field of the tracks, numbers or arrays over time, one per vehicle; a field
            that is not given is 0.
    """
    times_s = np.asarray(t_s)

    def column(name: str, kind: type) -> NDArray[np.float64]:
        rows = [np.broadcast_to(value, len(times_s)) for value in values.get(name, (0,) * count)]
        return np.concatenate([np.empty(0), *rows]).astype(kind)

    kinds: dict[str, type] = dict.fromkeys(
        ("s_m", "y_m", "speed_mps", "lateral_speed_mps", "accel_mps2"), float
    )
    kinds |= dict.fromkeys(("column", "lane", "reserved_column", "reserved_lane"), np.int64)
    return Tracks(
        names=tuple(f"v{number}" for number in range(count)),
        starts=len(times_s) * np.arange(count + 1),
        t_s=np.tile(times_s, count),
        **{name: column(name, kind) for name, kind in kinds.items()},  # type: ignore[arg-type]
    )
