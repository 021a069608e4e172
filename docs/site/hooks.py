"""Hooks of the site: pages from outside of docs/, links to files of the repository, diagrams.

A link in a document names a file of the repository by a relative path, so that it works in any
repository browser. The site contains the home page (README.md), the changelog and the guide for
contributors as pages. Every other file or folder that a page links to is a page of its own in
`repository/`. A link to a file that does not exist stays as it is, so that a strict build fails.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
}
"""Files in the root that are pages of the navigation, each with the address of its page."""
LANGUAGES = {".py": "python", ".toml": "toml", ".yaml": "yaml", ".json": "json"}
MERMAID = "site/mermaid.tiny.js"
"""Script that draws the diagrams (MIT licence, beside it)."""
SEARCH = "site/iframe-worker.js"
"""Script with which the search works in local files (MIT licence, beside it)."""
SEARCH_FROM_NETWORK = "https://unpkg.com/iframe-worker/shim"

_DIAGRAM = re.compile(r'(<pre class="mermaid">.*?</pre>)', re.DOTALL)
_FENCE = re.compile(r"(^````.*?^````$|^```.*?^```$)", re.MULTILINE | re.DOTALL)
_NAMED = re.compile(r"\[([A-Z_]+\.md)\](?=\(([^)\s#]+))")
_TARGET = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)\s#]+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that come from outside of docs/."""
    pages = dict.fromkeys(PAGES)
    waiting = [*pages, *(f"docs/{file.src_uri}" for file in files.documentation_pages())]
    while waiting:
        source = waiting.pop()
        for target in _linked(_markdown(source), source):
            if target not in pages and not target.startswith("docs/"):
                pages[target] = None
                waiting.append(target)
    for source in pages:
        files.append(File.generated(config, _address(source), content=_markdown(source)))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Return the page with addresses and titles of pages in place of paths in the repository."""
    source = _source(page.file.src_uri)
    if page.file.src_uri.startswith(("adr/", "repository/")):
        page.meta["search"] = {"boost": 0.2}  # found, but after the guides and the reference

    def address(match: re.Match[str]) -> str:
        target = _resolved(source, match[1])
        if not (ROOT / target).exists():
            return match[1]
        return os.path.relpath(_address(target), PurePosixPath(page.file.src_uri).parent)

    def title(match: re.Match[str]) -> str:
        target = ROOT / _resolved(source, match[2])
        if not target.is_file():
            return match[0]
        heading = target.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
        return f'["{heading}"]'

    parts = _FENCE.split(markdown)
    parts[::2] = [_TARGET.sub(address, _NAMED.sub(title, part)) for part in parts[::2]]
    return "".join(parts)


def on_page_content(html: str, **_: object) -> str:
    """Put each diagram into a box that scrolls on small screens."""
    return _DIAGRAM.sub(r'<div class="wide">\1</div>', html)


def on_post_page(output: str, page: Page, **_: object) -> str:
    """Load scripts from the site itself: that of the search, and in pages with diagrams theirs."""
    top = "../" * page.file.dest_uri.count("/")
    if 'class="mermaid"' in output:
        output = output.replace("</head>", f'<script src="{top}{MERMAID}"></script></head>')
    return output.replace(SEARCH_FROM_NETWORK, top + SEARCH)


def on_post_template(output: str, **_: object) -> str:
    """Load the script of the search from the site in the page for unknown addresses."""
    return output.replace(SEARCH_FROM_NETWORK, f"/{SEARCH}")


def _markdown(source: str) -> str:
    """Return a file or folder of the repository as a page."""
    path = ROOT / source
    if path.is_dir():
        names = sorted(one.relative_to(path).as_posix() for one in path.rglob("*.*"))
        shown = [name for name in names if (path / name).suffix in {".md", *LANGUAGES}]
        return f"# {source}\n\n" + "".join(f"- [{name}]({name})\n" for name in shown)
    text = path.read_text(encoding="utf-8")
    if source.endswith(".md"):
        return text
    return f"# {source}\n\n````{LANGUAGES.get(path.suffix, 'text')}\n{text}````\n"


def _linked(text: str, source: str) -> Iterator[str]:
    """Yield the files and folders of the repository to which a page links."""
    for part in _FENCE.split(text)[::2]:
        for target in _TARGET.findall(part):
            resolved = _resolved(source, target)
            if (ROOT / resolved).exists():
                yield resolved


def _resolved(source: str, target: str) -> str:
    """Return the path in the repository of a link's target."""
    folder = source if (ROOT / source).is_dir() else PurePosixPath(source).parent
    return os.path.normpath(PurePosixPath(folder) / target)


def _address(source: str) -> str:
    """Return the address in the site of a file or folder of the repository."""
    if source in PAGES:
        return PAGES[source]
    if source.startswith("docs/"):
        return source.removeprefix("docs/")
    if (ROOT / source).is_dir():
        return f"repository/{source}/index.md"
    return f"repository/{source}" if source.endswith(".md") else f"repository/{source}.md"


def _source(address: str) -> str:
    """Return the file or folder of the repository that a page shows."""
    roots = {page: name for name, page in PAGES.items()}
    if address in roots:
        return roots[address]
    if address.startswith("repository/"):
        path = address.removeprefix("repository/")
        found = (path, path.removesuffix(".md"), path.removesuffix("/index.md"))
        return next(one for one in found if (ROOT / one).exists())
    return f"docs/{address}"
