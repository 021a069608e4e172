"""The script that draws a road on a canvas (`road.js`), shared by reports and the live page."""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files


@lru_cache(maxsize=32)
def text_of(package: str, name: str) -> str:
    """Return a text file that is part of a package."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def road_script() -> str:
    """Return the script that draws roads; it defines `laneweaveRoad`."""
    return text_of(__name__, "road.js")
