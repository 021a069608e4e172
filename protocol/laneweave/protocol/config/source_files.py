"""Text files from users: reading them, and the line of each value for errors."""

from __future__ import annotations

import codecs
import json
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from attrs import frozen

from laneweave.protocol.errors import BadInputError, Described, combined
from laneweave.protocol.structuring import path_keys

STDIN: Final = Path("-")
MAX_TOML_BYTES: Final = 1 << 20
_MAX_PARSED: Final = 1 << 22
"""Number of characters parsed in search of lines, after which only the lines found are known."""
_UTF_16: Final = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)

Keys = tuple[str, ...]
"""Path of a value: keys of tables, and indices of arrays as text."""
Lines = Mapping[Keys, int]
"""First line of each value."""


@frozen
class SourceFile:
    """A file with nested tables."""

    name: str
    """Name of the file in errors."""
    text: str
    tables: dict[str, Any]
    find_lines: Callable[[str], Lines]

    @contextmanager
    def located(self, given: Collection[str] = ()) -> Iterator[None]:
        """Add file and line to errors about the tables, and sort the errors by line.

        Args:
            given: fields whose values come from elsewhere, such as options.
        """
        try:
            yield
        except BadInputError as error:
            lines = self.find_lines(self.text)
            found = [(0, one) for one in error.problems if one.field in given]
            for one in error.problems:
                if one.field not in given:
                    line = _line_of(path_keys(one.field), lines)
                    found.append((line, one.at(f"{self.name}:{line}" if line else self.name)))
            raise combined(one for _, one in sorted(found, key=lambda item: item[0])) from None


def read_text(path: Path, field: str, kind: str, max_bytes: int) -> str:
    """Return the text of a file without its byte-order mark.

    Args:
        path: the file; `STDIN`: standard input.
        field: field named in errors.
        kind: kind of file, for errors.
        max_bytes: maximum size.

    Raises:
        BadInputError: the file cannot be read, is too large, or is not text in UTF-8.
    """
    try:
        if path == STDIN:
            data = sys.stdin.buffer.read(max_bytes + 1)
        else:
            with path.open("rb") as file:
                data = file.read(max_bytes + 1)
    except OSError as error:
        raise BadInputError(field, str(path), f"a readable file ({error.strerror})") from error
    except ValueError as error:  # a NUL in the path
        raise BadInputError(field, str(path), f"a readable file ({error})") from error
    if len(data) > max_bytes:
        size = Described(f"{shown_name(path)!r}, which is larger")
        raise BadInputError(field, size, f"at most {max_bytes} bytes")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        why = "it is UTF-16" if data[:2] in _UTF_16 else f"byte {error.start} is not"
        raise BadInputError(field, shown_name(path), f"valid {kind} in UTF-8 ({why})") from error


def shown_name(path: Path) -> str:
    """Return the name of a file in errors."""
    return "stdin" if path == STDIN else str(path)


def read_toml_source(path: Path) -> SourceFile:
    """Read a TOML file.

    Raises:
        BadInputError: the file cannot be read or is not TOML.
    """
    text = read_text(path, "file", "TOML", MAX_TOML_BYTES)
    try:
        return SourceFile(str(path), text, tomllib.loads(text), toml_lines)
    except (ValueError, RecursionError) as error:
        # Not TOML, too many digits, nested too deep.
        raise BadInputError("file", str(path), f"valid TOML ({error})") from error


def toml_lines(text: str) -> dict[Keys, int]:
    """Return the first line of each table and each key of a valid TOML file.

    Values inside of arrays and inline tables are on the line of their key.
    """
    lines: dict[Keys, int] = {}
    sizes: dict[Keys, int] = {}
    """Number of tables in each array of tables so far."""
    table: Keys = ()
    statement, first, parsed = "", 1, 0
    for number, line in enumerate(text.splitlines(keepends=True), 1):
        if not statement:
            first = number
        statement += line
        parsed += len(statement)
        if parsed > _MAX_PARSED:
            break
        try:
            content = tomllib.loads(statement)
        except tomllib.TOMLDecodeError:
            continue  # goes on in the next line
        if statement.lstrip().startswith("["):
            table = _header(content, sizes)
            found = {table[:length] for length in range(1, len(table) + 1)}
        else:
            found = {(*table, *keys) for keys in _paths(content)}
        for keys in found:
            lines.setdefault(keys, first)
        statement = ""
    return lines


def _header(content: Mapping[str, Any], sizes: dict[Keys, int]) -> Keys:
    """Return the path of the table of a header; `content` is that of the header alone."""
    keys: Keys = ()
    inner: Any = content
    while inner:
        ((key, inner),) = inner.items()
        keys = (*keys, key)
        if isinstance(inner, list):
            sizes[keys] = sizes.get(keys, 0) + 1
            (inner,) = inner
        if keys in sizes:
            keys = (*keys, str(sizes[keys] - 1))
    return keys


def _paths(content: Mapping[str, Any]) -> Iterator[Keys]:
    """Yield the paths of all tables and values."""
    for key, value in content.items():
        yield (key,)
        if isinstance(value, Mapping):
            for keys in _paths(value):
                yield (key, *keys)


def unique_keys(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of a JSON text; for `object_pairs_hook` of `json.loads`.

    Raises:
        ValueError: a key is given more than once. JSON allows it, but only one value has an effect.
    """
    found = dict(pairs)
    if len(found) < len(pairs):
        counts = Counter(key for key, _ in pairs)
        raise ValueError(f"key {counts.most_common(1)[0][0]!r} is given more than once")
    return found


_JSON_TOKENS: Final = re.compile(r'"(?:[^"\\]|\\.)*"|[{}\[\],:]|[^\s{}\[\],:"]+')


def json_lines(text: str) -> dict[Keys, int]:
    """Return the line of each key and each item of a valid JSON text."""
    lines: dict[Keys, int] = {}
    keys: list[str | int] = []
    """The current key or index of each object and array around a token."""
    line, end, is_key = 1, 0, False
    for token in _JSON_TOKENS.finditer(text):
        line, end = line + text.count("\n", end, token.start()), token.start()
        word = token[0]
        if is_key and word[0] == '"':
            keys[-1] = json.loads(word)
            is_key = False
        if word not in ("}", "]", ",", ":"):
            lines.setdefault(tuple(map(str, keys)), line)
        if word in ("{", "["):
            is_key = word == "{"
            keys.append("" if is_key else 0)
        elif word in ("}", "]"):
            keys.pop()
            is_key = False
        elif word == ",":
            last = keys[-1]
            is_key = isinstance(last, str)
            keys[-1] = "" if isinstance(last, str) else last + 1
    return lines


def _line_of(keys: Keys, lines: Lines) -> int:
    """Return the line of a value, or of the innermost table around it; 0: unknown."""
    for length in range(len(keys), 0, -1):
        if keys[:length] in lines:
            return lines[keys[:length]]
    return 0
