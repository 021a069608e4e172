"""The script `road.js`, which draws a road on a canvas for reports and the live page."""

from __future__ import annotations

from importlib.resources import files


def text_of(package: str, name: str) -> str:
    """Return the text of a file in a package."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def road_script() -> str:
    """Return the script that draws roads and defines `laneweaveRoad`."""
    return text_of(__name__, "road.js")
