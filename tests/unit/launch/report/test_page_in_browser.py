"""The page of a report in a browser: the moving road, and narrow pages."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from laneweave.launch.recordings.runs import single_run
from laneweave.launch.report.report import report_run
from support.chromium import Page, needs_chromium, new_page
from support.variants import variants

pytestmark = [pytest.mark.slow, needs_chromium]


@pytest.fixture(scope="module")
def address(swept: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the address of the report of a run."""
    folder = tmp_path_factory.mktemp("page") / "run"
    shutil.copytree(swept / "formation-1600-1", folder)
    return report_run(single_run(folder), dpi=80).as_uri()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """Return a page in a browser."""
    yield from new_page(tmp_path_factory.mktemp("profile"))


def part(page: Page, name: str, expression: str) -> object:
    """Return the value of an expression of a part of the player."""
    return page.run(f"document.querySelector('[data-part={name}]').{expression}")


def test_following_does_not_change_the_time(page: Page, address: str) -> None:
    page.open(address)
    # In one script: the page plays, and the next frame would set the slider.
    page.run(
        "(time => { time.value = 30; time.dispatchEvent(new Event('input')); })"
        "(document.querySelector('[data-part=time]'))"
    )
    part(page, "view", "dispatchEvent(new Event('pointerdown'))")
    before = part(page, "now", "textContent")
    assert str(before).startswith("30.0 s")
    choices = page.run("[...document.querySelector('[data-part=view]').options].map((o) => o.text)")
    assert len(choices) > 2
    height = page.run("document.querySelector('canvas').clientHeight")
    for number in (1, len(choices) - 1):
        part(page, "view", f"selectedIndex = {number}")
        part(page, "view", "dispatchEvent(new Event('change'))")
        assert part(page, "now", "textContent") == before
        assert page.run("document.querySelector('canvas').clientHeight") != height
    assert page.console_errors() == []


@pytest.mark.parametrize("width", variants([420, 1280]))
def test_a_narrow_page_does_not_shrink_its_figures(page: Page, address: str, width: int) -> None:
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    page.open(address)
    # Tables and figures scroll in their boxes, the page does not.
    assert page.run("document.documentElement.scrollWidth <= innerWidth")
    for shown, natural in page.run(
        "[...document.images].map((one) => [one.clientWidth, Number(one.getAttribute('width'))])"
    ):
        assert shown >= min(natural, 1000)
    first = page.run("document.querySelector('main section h2').textContent")
    assert first == "The moving road"
    assert page.console_errors() == []
