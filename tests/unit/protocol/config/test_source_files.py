"""Files from users: their text, and the line of each value."""

from __future__ import annotations

import io
import json
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from laneweave.protocol.config.source_files import (
    MAX_TOML_BYTES,
    STDIN,
    SourceFile,
    json_lines,
    read_text,
    read_toml_source,
    toml_lines,
    unique_keys,
)
from laneweave.protocol.errors import BadInputError, SeveralBadInputsError
from support.refusals import refusal
from support.tables import for_each

TOML = '''\
seed = 1
# [ignored]
network.lease_s = 2.0

[road]
"lanes" = 3
text = """
[not a table]
lanes = 4
"""
closures = [
  { lane = 1, from_m = 2.0 },
  { lane = 2 },
]

[[exit]]
name = "a"
[[exit]]
name = "b"
  [exit.more]
  x = 1
[[exit.inner]]
y = 2
[[exit.inner]]
y = 3
'''
LINES = {
    ("seed",): 1,
    ("network",): 3,
    ("network", "lease_s"): 3,
    ("road",): 5,
    ("road", "lanes"): 6,
    ("road", "text"): 7,
    ("road", "closures"): 11,
    ("exit", "0"): 16,
    ("exit", "0", "name"): 17,
    ("exit", "1"): 18,
    ("exit", "1", "name"): 19,
    ("exit", "1", "more"): 20,
    ("exit", "1", "more", "x"): 21,
    ("exit", "1", "inner", "0"): 22,
    ("exit", "1", "inner", "0", "y"): 23,
    ("exit", "1", "inner", "1"): 24,
    ("exit", "1", "inner", "1", "y"): 25,
}


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_lines_of_toml(end: str) -> None:
    tomllib.loads(TOML)
    found = toml_lines(TOML.replace("\n", end))
    assert {keys: line for keys, line in found.items() if keys in LINES} == LINES
    assert not [keys for keys in found if "not a table" in keys or "ignored" in keys]


@pytest.mark.more
def test_lines_of_a_huge_array_are_searched_for_a_limited_time() -> None:
    text = "a = 1\nb = [\n" + "1,\n" * 20_000 + "]\nc = 2\n"
    assert toml_lines(text) == {("a",): 1}


JSON = """\
{"schema": "x",
 "grid": {"columns": 8,
          "lanes": 3},
 "te\\"xt": "{[:,",
 "vehicles": [
   {"id": "a", "cell": [0, 1]},

   {"id": "b", "cell": [
      2,
      3]}],
 "empty": [], "none": {}}
"""


def test_lines_of_json() -> None:
    assert json.loads(JSON)
    lines = json_lines(JSON)
    assert lines["schema",] == 1
    assert (lines["grid", "columns"], lines["grid", "lanes"]) == (2, 3)
    assert lines['te"xt',] == 4
    assert (lines["vehicles",], lines["vehicles", "0"], lines["vehicles", "1", "id"]) == (5, 6, 8)
    assert (lines["vehicles", "1", "cell", "0"], lines["vehicles", "1", "cell", "1"]) == (9, 10)
    assert lines["empty",] == lines["none",] == 11


def error(field: str) -> BadInputError:
    return BadInputError(field, 1, "2")


def located(*fields: str, given: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Return the places of errors about fields of `TOML`."""
    file = SourceFile("x.toml", TOML, tomllib.loads(TOML), toml_lines)
    problems = [error(field) for field in fields]
    with pytest.raises(BadInputError) as caught, file.located(given):
        raise SeveralBadInputsError(problems) if len(problems) > 1 else problems[0]
    return tuple(one.place for one in caught.value.problems)


@pytest.mark.parametrize(
    ("field", "place"),
    [
        ("road.lanes", "x.toml:6"),
        ("road.closures[1].lane", "x.toml:11"),
        ("road.s1_m", "x.toml:5"),
        ("exit[1].name", "x.toml:19"),
        ("exit[1].at_m", "x.toml:18"),
        ("formation.gap_m", "x.toml"),
    ],
)
def test_an_error_has_the_line_of_its_value_or_of_the_table_around_it(
    field: str, place: str
) -> None:
    assert located(field) == (place,)


def test_errors_are_sorted_by_line_and_those_of_options_have_none() -> None:
    places = located("exit[1].name", "road.lanes", "seed", given=("seed",))
    assert places == ("", "x.toml:6", "x.toml:19")


@for_each(
    ("content", "said"),
    [
        (b"\xff\xfea\x00", "valid TOML in UTF-8 (it is UTF-16)"),
        (b"a = '\xe4'", "valid TOML in UTF-8 (byte 5 is not)"),
        (b"a = 1\n" * MAX_TOML_BYTES, f"at most {MAX_TOML_BYTES} bytes"),
        (b"a = 1\na = 2\n", "valid TOML (Cannot overwrite a value (at line 2, column 6))"),
        (b"a = " + b"9" * 5000, "valid TOML (Exceeds the limit"),
        (b"a = " + b"[" * 5000, "valid TOML (maximum recursion depth"),
        (b"\x00", "valid TOML (Invalid statement"),
    ],
)
def test_text_that_cannot_be_read(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(content)
    error = refusal(read_toml_source, path)
    assert (error.field, error.allowed[: len(said)]) == ("file", said)


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(b"\xef\xbb\xbfseed = 1\r\n")
    assert read_toml_source(path).tables == {"seed": 1}


def test_standard_input_has_the_same_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    def read(data: bytes) -> str:
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(data)))
        return read_text(STDIN, "FILE", "JSON", 4)

    assert read(b"abcd") == "abcd"
    assert "'stdin', which is larger" in str(refusal(read, b"abcde"))


def test_a_key_is_given_once() -> None:
    def parse(text: str) -> Any:  # noqa: ANN401 (any JSON)
        return json.loads(text, object_pairs_hook=unique_keys)

    assert parse('{"a": {"b": 1}, "b": 2}') == {"a": {"b": 1}, "b": 2}
    with pytest.raises(ValueError, match="key 'b' is given more than once"):
        parse('{"a": {"b": 1, "b": 1}}')
