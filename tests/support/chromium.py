"""A real Chromium for tests of pages: Debian's, which downloads nothing."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from attrs import frozen
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

PROGRAM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
WAIT_S = 30.0

needs_chromium = pytest.mark.skipif(
    PROGRAM is None or DRIVER is None,
    reason="chromium and chromium-driver are not installed: there is no browser to test in",
)


@frozen
class Page:
    """What a test does with a page."""

    driver: webdriver.Chrome

    def open(self, address: str) -> None:
        """Go to an address; what an earlier page had to say does not count."""
        self.driver.get("about:blank")
        self.complaints()
        self.driver.get(address)

    def run(self, script: str) -> Any:  # noqa: ANN401 - any JSON
        """Return the value of an expression in the page."""
        return self.driver.execute_script(f"return {script}")

    def text(self, identity: str) -> str:
        """Return what an element says."""
        return str(self.run(f"document.getElementById('{identity}').textContent"))

    def click(self, identity: str) -> None:
        """Click on an element, as a hand would: where it can be seen."""
        self.driver.find_element("id", identity).click()

    def wait_until(self, condition: Callable[[], object]) -> None:
        """Wait until something is as it should be."""
        give_up = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < give_up, self.run("document.body.innerText")
            time.sleep(0.05)

    def complaints(self) -> list[str]:
        """Return what the page has written to the console since the last call."""
        return [str(entry["message"]) for entry in self.driver.get_log("browser")]  # type: ignore[no-untyped-call]


def new_page(profile: Path) -> Iterator[Page]:
    """Yield a page in a browser of its own, which ends with it."""
    options = webdriver.ChromeOptions()
    options.binary_location = str(PROGRAM)
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--disable-background-networking",
        "--window-size=1400,1050",
        "--hide-scrollbars",
        f"--user-data-dir={profile}",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    # With both paths given, selenium looks for nothing.
    driver = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
    try:
        yield Page(driver)
    finally:
        driver.quit()
