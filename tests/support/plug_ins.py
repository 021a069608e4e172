"""Distributions with entry points, made up and installed for one test."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from laneweave.protocol import plug_ins

Install = Callable[[str, Mapping[str, str], str], None]
"""Installs a distribution: its name, attribute of each entry point, and source of its module."""


@contextmanager
def installing(folder: Path, group: str) -> Iterator[Install]:
    """Yield a function that installs distributions with entry points of `group` in a new folder."""
    folder.mkdir()
    modules = set(sys.modules)
    sys.path.insert(0, str(folder))

    def install(distribution: str, names: Mapping[str, str], source: str) -> None:
        write_distribution(folder, distribution, group, names, source)
        importlib.invalidate_caches()
        plug_ins._entry_points.cache_clear()

    try:
        yield install
    finally:
        sys.path.remove(str(folder))
        plug_ins._entry_points.cache_clear()
        for name in set(sys.modules) - modules:
            if str(folder) in str(getattr(sys.modules[name], "__file__", "")):
                del sys.modules[name]


def write_distribution(
    folder: Path, distribution: str, group: str, names: Mapping[str, str], source: str
) -> None:
    """Write a module, and the metadata that pip would write for its distribution."""
    (folder / f"{distribution}.py").write_text(source, encoding="utf-8")
    info = folder / f"{distribution}-1.2.dist-info"
    info.mkdir()
    metadata = f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.2\n"
    (info / "METADATA").write_text(metadata, encoding="utf-8")
    lines = [f"{name} = {distribution}:{attribute}" for name, attribute in names.items()]
    (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines]), encoding="utf-8")
