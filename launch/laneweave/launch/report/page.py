"""The page of a report: one file that needs no other, and no network."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, Final

from attrs import field, frozen

from laneweave.launch.drawing.colours import lane_names
from laneweave.launch.web import road_script
from laneweave.protocol.files import write_atomically

PAGE_FILE: Final = "report.html"
_TEMPLATES = files("laneweave.launch.report") / "templates"
_PACES = (0.5, 1, 2, 5, 10)
_DEFAULT_PACE = 2
_CSS_PIXELS_PER_IN = 110
"""A little more than the standard 96: letters of 8 pt shall be readable."""


@frozen
class Section:
    """A part of the page."""

    title: str
    body: str
    """HTML."""


@frozen
class Page:
    """What is on the page."""

    title: str
    lead: str
    sections: Sequence[Section]
    animations: Sequence[Mapping[str, Any]] = field(factory=tuple)
    """Data of the players, in the order of their numbers."""


def write_page(page: Page, folder: Path) -> Path:
    """Write the page whole or not at all, and return its path."""
    navigation = "".join(
        f'<a href="#part-{number}">{escape(section.title)}</a>'
        for number, section in enumerate(page.sections)
    )
    sections = "\n".join(
        f'<section id="part-{number}"><h2>{escape(section.title)}</h2>\n{section.body}</section>'
        for number, section in enumerate(page.sections)
    )
    data = "\n".join(
        f'<script type="application/json" id="{_animation_id(number)}">{_inert(one)}</script>'
        for number, one in enumerate(page.animations)
    )
    text = Template(_template("page.html")).substitute(
        title=escape(page.title),
        lead=escape(page.lead),
        style=_template("style.css"),
        navigation=navigation,
        sections=sections,
        data=data,
        script=_script() if page.animations else "",
    )
    path = folder / PAGE_FILE
    write_atomically(path, text)
    return path


def picture(path: Path, dpi: float, caption: str, alt: str) -> str:
    """Return a figure with a PNG picture, which is in the page itself, in its natural size."""
    png = path.read_bytes()
    # The header of a PNG begins with width and height, big-endian, after 16 bytes.
    width_px = int.from_bytes(png[16:20], "big") * _CSS_PIXELS_PER_IN / dpi
    content = base64.b64encode(png).decode("ascii")
    return (
        f'<figure><img width="{width_px:.0f}" alt="{escape(alt)}" '
        f'src="data:image/png;base64,{content}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def player(number: int, data: Mapping[str, Any]) -> str:
    """Return the place in which an animation is shown, with its controls."""
    paces = "".join(
        f'<option value="{pace:g}"{" selected" if pace == _DEFAULT_PACE else ""}>{pace:g}x</option>'
        for pace in _PACES
    )
    return Template(_template("player.html")).substitute(
        id=_animation_id(number), title=escape(data["title"]), paces=paces, legend=_legend(data)
    )


def _legend(data: Mapping[str, Any]) -> str:
    names = lane_names(data["road"]["lanes"])
    entries: Iterable[tuple[str, str]] = zip(data["colours"], names, strict=False)
    speed_mps = data["lattice"]["speed_mps"]
    return (
        "".join(
            f'<span><i style="background:{escape(colour)}"></i>prefers {escape(name)}</span>'
            for colour, name in reversed(list(entries))
        )
        + f"<span>darker: slower than {speed_mps:g} m/s; lighter: faster</span>"
    )


def _animation_id(number: int) -> str:
    return f"animation-{number}"


def _inert(data: Mapping[str, Any]) -> str:
    """Return JSON that cannot end the script element that it is in."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _script() -> str:
    # "use strict" stands in two of them; the second time it is a text that does nothing.
    return road_script() + _template("player.js") + _template("stage.js")


def _template(name: str) -> str:
    return (_TEMPLATES / name).read_text(encoding="utf-8")
