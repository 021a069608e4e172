"""The site of the documents: its navigation, its build, and what every page has."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from support.tables import for_each

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
MAX_README_LINES = 150
MAX_ROWS = 100
"""Rows of a table outside of the reference."""
NO_MKDOCS = "the site is not built: mkdocs-material is not installed (extra dev)"
needs_mkdocs = pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason=NO_MKDOCS)


class Settings(yaml.SafeLoader):
    """Reads mkdocs.yml; the functions of Markdown extensions in it are left out."""


Settings.add_multi_constructor("tag:yaml.org,2002:python/", lambda *_: None)


def navigation() -> dict[str, Any]:
    """Return the entries of the first level, by title."""
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    entries = yaml.load(text, Settings)["nav"]  # noqa: S506
    return {title: value for entry in entries for title, value in entry.items()}


def pages_of(entry: Any) -> Iterator[str]:  # noqa: ANN401
    if isinstance(entry, str):
        yield entry
    for inner in [] if isinstance(entry, str) else entry:
        yield from pages_of(list(inner.values()) if isinstance(inner, dict) else inner)


def test_the_readme_is_short() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= MAX_README_LINES


def test_make_site_fails_on_warnings() -> None:
    # `--quiet` would hide the warnings from `--strict`, too.
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(r"^site:.*\n\t.*/mkdocs build --strict$", makefile, re.MULTILINE)


def test_every_page_is_in_the_navigation_once() -> None:
    listed = list(pages_of(list(navigation().values())))
    outside = ["index.md", "CHANGELOG.md", "CONTRIBUTING.md"]
    assert sorted(listed) == sorted([*outside, *(path.name for path in PAGES)])


@for_each("path", PAGES)
def test_a_page_opens_with_whom_it_is_for(path: Path) -> None:
    title, opening = path.read_text(encoding="utf-8").split("\n\n", 2)[:2]
    assert title.startswith("# ")
    assert re.match(r"\*?For ", opening), opening


@for_each("path", PAGES)
def test_long_tables_are_in_the_reference(path: Path) -> None:
    if path.name in pages_of(navigation()["Reference"]):
        return
    tables = re.findall(r"(?:^\|.*\n)+", path.read_text(encoding="utf-8"), re.MULTILINE)
    assert all(table.count("\n") <= MAX_ROWS for table in tables)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[str, str]:
    """Return the pages of the built site by address."""
    return {
        path.relative_to(site).as_posix(): path.read_text(encoding="utf-8")
        for path in site.rglob("*.html")
    }


@needs_mkdocs
@pytest.mark.slow
@pytest.mark.more
def test_the_site_builds_without_a_warning(pages: dict[str, str]) -> None:
    for path in PAGES:
        assert f"{path.stem}.html" in pages
    assert "Two commands" in pages["index.html"]
    assert "veh_per_lane_h" in pages["repository/scenarios/demo.toml.html"]
    assert 'href="repository/scenarios/demo.toml.html"' in pages["index.html"]
    assert '<a href="PROTOCOL.html">"Protocol"</a>' in pages["SAFETY.html"]


@needs_mkdocs
@pytest.mark.slow
@pytest.mark.more
def test_the_site_needs_no_network(pages: dict[str, str]) -> None:
    for address, text in pages.items():
        loaded = re.findall(
            r'<(?:script|img|link rel="stylesheet")[^>]*(?:src|href)="([^"]+)"', text
        )
        assert loaded, address
        assert not [one for one in loaded if re.match(r"(https?:)?//", one)], address


@needs_mkdocs
@pytest.mark.slow
@pytest.mark.more
def test_links_between_pages_lead_to_files(site: Path, pages: dict[str, str]) -> None:
    for address, text in pages.items():
        if address == "404.html":  # its links begin at the root of a server
            continue
        for target in re.findall(r'(?:src|href)="(?!\w+:|#)([^"#?]+)', text):
            assert ((site / address).parent / target).exists(), (address, target)
