"""The page of a report: a self-contained HTML file."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from attrs import frozen
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from laneweave.launch.drawing.road_scene import closed_parts_script
from laneweave.launch.report.tables import Table
from laneweave.launch.web import road_script, text_of
from laneweave.protocol.files import write_atomically

PAGE_FILE: Final = "report.html"
_PACKAGE: Final = "laneweave.launch.report"
_PACES: Final = (0.5, 1, 2, 5, 10)
_CSS_PIXELS_PER_IN = 110
"""Slightly more than the standard 96, so that 8 pt text is legible."""


@frozen
class Picture:
    """A PNG file that is embedded in the page at its natural size."""

    path: Path
    dpi: float
    caption: str
    alt: str

    @property
    def base64(self) -> str:
        """The content of the file."""
        return base64.b64encode(self.path.read_bytes()).decode("ascii")

    @property
    def width_px(self) -> int:
        """Width on the page, in CSS pixels."""
        with self.path.open("rb") as png:
            # The header of a PNG begins with width and height, big-endian, after 16 bytes.
            return round(int.from_bytes(png.read(20)[16:], "big") * _CSS_PIXELS_PER_IN / self.dpi)


@frozen
class Animation:
    """An animated road, with data from `animation.animation_data`."""

    data: Mapping[str, Any]


@frozen
class Section:
    """A section of the page."""

    title: str
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    animations: Sequence[Animation] = ()
    note: str = ""
    """A sentence above the pictures."""


def keep_units(text: str) -> str:
    """Return text in which a number stays on one line with its unit and its deviation."""
    return re.sub(r"(?<=\d) (?=[^\W\d]|%|±|\()|(?<=±) ", "\u00a0", text)


def render_page(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return the HTML of a page; text is escaped."""
    environment = Environment(
        loader=PackageLoader(_PACKAGE), autoescape=True, undefined=StrictUndefined
    )
    environment.filters["keep_units"] = keep_units
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    # Several scripts contain "use strict"; only the first one has an effect.
    scripts = road_script() + closed_parts_script() + _file("player.js") + _file("controls.js")
    return environment.get_template("page.html").render(
        title=title,
        lead=lead,
        sections=sections,
        animations=[one for section in sections for one in section.animations],
        paces=_PACES,
        style=Markup(_file("style.css")),  # noqa: S704 (a file of this package)
        script=Markup(scripts),  # noqa: S704 (as above)
    )


def write_page(
    title: str, lead: str, sections: Sequence[Section], folder: Path, name: str = PAGE_FILE
) -> Path:
    """Write a page atomically to a file of a folder, and return its path."""
    path = folder / name
    write_atomically(path, render_page(title, lead, sections))
    return path


def _file(name: str) -> str:
    return text_of(_PACKAGE, f"templates/{name}")
