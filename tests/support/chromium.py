"""Chromium, as Debian installs it, for tests of web pages."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from attrs import frozen
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

from support.waiting import wait_until

NO_BROWSER = "no browser: chromium and chromium-driver are not installed"
PROGRAM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
WAIT_S = 60.0

needs_chromium = pytest.mark.skipif(PROGRAM is None or DRIVER is None, reason=NO_BROWSER)


@frozen
class Page:
    """A page in a browser."""

    driver: webdriver.Chrome

    def open(self, address: str) -> None:
        """Open an address and discard the console output of the page before."""
        self.driver.get("about:blank")
        self.console_errors()
        self.driver.get(address)

    def run(self, script: str) -> Any:  # noqa: ANN401 - any JSON
        """Return the value of an expression in the page."""
        return self.driver.execute_script(f"return {script}")

    def text(self, identity: str) -> str:
        """Return the text of an element, with plain spaces."""
        text = str(self.run(f"document.getElementById('{identity}').textContent"))
        return text.replace("\u00a0", " ")

    def click(self, identity: str) -> None:
        """Click on an element, which must be visible."""
        self.driver.find_element("id", identity).click()

    def wait_until(self, condition: Callable[[], object]) -> None:
        """Wait until a condition holds; fail with the page's text after `WAIT_S`."""
        wait_until(condition, WAIT_S, lambda: self.run("document.body.innerText"))

    def console_errors(self) -> list[str]:
        """Return what the page has written to the console since the last call."""
        return [str(entry["message"]) for entry in self.driver.get_log("browser")]  # type: ignore[no-untyped-call]


def new_page(profile: Path) -> Iterator[Page]:
    """Yield a page in its own browser, and quit the browser afterwards."""
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
    # With both paths given, selenium does not search for or download a driver.
    driver = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
    try:
        yield Page(driver)
    finally:
        driver.quit()
