"""The reference of the Python interface in API.md, from the docstrings of the public names.

Static analysis, as other tools do it, does not see the public names: `laneweave` imports each of
them on first use, and the five packages below it come from five folders.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from functools import cached_property
from types import ModuleType
from typing import Any

import attrs
from griffe import Docstring, DocstringElement, Parser

import laneweave

HEADINGS = {
    "parameters": "Arguments",
    "attributes": "Attributes",
    "raises": "Errors",
    "returns": "Returns",
    "yields": "Yields",
}
"""Heading of each kind of list in a docstring."""
ELSEWHERE = {
    "laneweave.Scenario": "[SCENARIO.md](SCENARIO.md#all-fields) lists all fields.",
    "laneweave.RunSummary": "[RESULT_FILES.md](RESULT_FILES.md#summaryjson) lists all fields.",
}
"""Classes whose fields another page describes."""


def api_reference(module: ModuleType) -> str:
    """Return a section for each public name of a module."""
    name = module.__name__
    return "\n\n".join(
        _section(f"{name}.{one}", getattr(module, one)) for one in sorted(module.__all__)
    )


def _section(name: str, value: object) -> str:
    public = name.rpartition(".")[2]
    if name != f"laneweave.{public}" and public in laneweave.__all__:
        return f"## {name}\n\nThe same as [laneweave.{public}](API.md#laneweave{public.lower()})."
    if inspect.isclass(value) and not hasattr(value, "__args__"):
        return "\n\n".join(_class_parts(name, value))
    if inspect.isfunction(value):
        return f"## {name}\n\n{_signature(name, value)}\n\n{_text(value)}"
    if isinstance(value, str):
        return f"## {name}\n\nThe version of the installed package, as text."
    alias = re.sub(r"\b(?:[a-z_]+\.)+(?=[A-Z])", "", str(value))
    return f"## {name}\n\n```python\n{alias}\n```"


def documented(node: ast.Module | ast.ClassDef) -> Iterator[tuple[str, str]]:
    """Yield the annotated names of a module or class, each with the docstring below it."""
    for statement, below in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            text = ""
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                text = " ".join(str(below.value.value).split()).removesuffix(".")
            yield statement.target.id, text


def _class_parts(name: str, kind: type) -> Iterator[str]:
    yield f"## {name}"
    yield _text(kind)
    if name in ELSEWHERE:
        yield ELSEWHERE[name]
        return
    if attrs.has(kind):
        yield _fields(kind)
    elif not issubclass(kind, BaseException) and not getattr(kind, "_is_protocol", False):
        yield _signature(name, kind)
    for member, found in vars(kind).items():
        inner = found.__func__ if isinstance(found, (classmethod, staticmethod)) else found
        if member == "__call__" and inspect.isfunction(inner):
            yield f"{_signature(name, inner)}\n\n{_text(inner)}"
        if member.startswith("_") or not inspect.getdoc(inner):
            continue
        if isinstance(inner, (property, cached_property)):
            yield f"### {name}.{member}\n\n{_text(inner)}"
        elif inspect.isfunction(inner):
            yield f"### {name}.{member}\n\n{_signature(member, inner)}\n\n{_text(inner)}"


def _fields(kind: type) -> str:
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    node = next(node for node in tree.body if isinstance(node, ast.ClassDef))
    meanings = dict(documented(node))
    annotations = {
        one.target.id: ast.unparse(one.annotation)
        for one in node.body
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)
    }
    rows = [
        [f"`{name}`", f"`{_cell(annotations[name])}`", _cell(meanings[name])]
        for name in (one.name for one in attrs.fields(kind))
        if name in annotations and not name.startswith("_")
    ]
    head = ["field", "type", "meaning"]
    if not any(meaning for *_, meaning in rows):  # the class docstring describes its fields
        head, rows = head[:2], [row[:2] for row in rows]
    cells = "\n".join(f"| {' | '.join(line)} |" for line in [head, *rows])
    return cells.replace("\n", "\n" + "|---" * len(head) + "|\n", 1)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _signature(name: str, value: Callable[..., Any]) -> str:
    """Return a call with its parameters, one a line where they are many."""
    signature = inspect.signature(value)
    parameters = [one for one in signature.parameters.values() if one.name not in ("self", "cls")]
    text = re.sub(r"(: |-> )'([^']*)'", r"\1\2", str(signature.replace(parameters=parameters)))
    line = f"{name}{text}"
    if len(line) > 90:
        inner, _, result = text[1:].rpartition(")")
        line = f"{name}(\n" + "".join(f"    {one},\n" for one in _split(inner)) + f"){result}"
    return f"```python\n{line}\n```"


def _split(parameters: str) -> Iterator[str]:
    """Yield the parameters of a signature; commas in brackets do not separate."""
    depth = begin = 0
    for place, letter in enumerate(parameters):
        depth += (letter in "([{") - (letter in ")]}")
        if letter == "," and depth == 0:
            yield parameters[begin:place].strip()
            begin = place + 1
    yield parameters[begin:].strip()


def _text(value: object) -> str:
    """Return a docstring as Markdown, with its lists of arguments, results and errors."""
    paragraphs = (inspect.getdoc(value) or "").split("\n\n")
    text = "\n\n".join(part for paragraph in paragraphs for part in _parts(paragraph))
    return re.sub(r"docs/([A-Z_]+\.md)", r"[\1](\1)", text)


def _parts(paragraph: str) -> Iterator[str]:
    if re.match(r"[a-z_]+(, [a-z_]+)*: ", paragraph):  # lines such as `cost, steps: meaning`
        lines = re.sub(r"\n +", " ", paragraph).splitlines()
        yield "\n".join(re.sub(r"^([\w, -]+):", r"- `\1`:", line) for line in lines)
        return
    if paragraph.startswith("    "):
        yield f"```python\n{textwrap.dedent(paragraph)}\n```"
        return
    # `Docstring` removes the indentation that all lines but the first one have.
    for section in Docstring(f"\n{paragraph}", parser=Parser.google).parse(
        warnings=False, returns_multiple_items=False
    ):
        kind = section.kind.value
        if kind == "text":
            yield section.value
        else:
            items = [f"- {_item(one)}" for one in section.value]
            yield f"**{HEADINGS[kind]}**\n\n" + "\n".join(items)


def _item(one: DocstringElement) -> str:
    name = getattr(one, "name", "") or getattr(one, "annotation", "") or ""
    text = " ".join(one.description.split())
    return f"`{name}`: {text}" if name else text
