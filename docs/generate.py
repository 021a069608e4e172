"""Writes the parts of the documents that follow from the code: `python docs/generate.py`.

In a document a generated part stands between `<!-- begin NAME -->` and `<!-- end NAME -->`; a test
compares it with what this script would write.
"""

from __future__ import annotations

import re
from pathlib import Path

from laneweave.coordinator.leader_rules import LEADER_RULES, Phase
from laneweave.protocol.execution import VEHICLE_RULES, Stage
from laneweave.protocol.transitions import markdown_table, mermaid_diagram

DOCS = Path(__file__).resolve().parent


def _diagram(text: str) -> str:
    return f"```mermaid\n{text}\n```"


def parts() -> dict[str, str]:
    """Return each generated part by its name."""
    return {
        "vehicle rules": markdown_table(VEHICLE_RULES),
        "vehicle phases": _diagram(mermaid_diagram(VEHICLE_RULES, Stage.FREE)),
        "leader rules": markdown_table(LEADER_RULES),
        "leader phases": _diagram(mermaid_diagram(LEADER_RULES, Phase.OBSERVING)),
    }


def rewritten(text: str) -> str:
    """Return a document's text with its generated parts as they should be."""
    known = parts()

    def replace(match: re.Match[str]) -> str:
        name = match[1]
        return f"<!-- begin {name} -->\n{known[name]}\n<!-- end {name} -->"

    return re.sub(r"<!-- begin ([\w ]+) -->\n.*?<!-- end \1 -->", replace, text, flags=re.DOTALL)


if __name__ == "__main__":
    for path in sorted(DOCS.glob("*.md")):
        path.write_text(rewritten(path.read_text(encoding="utf-8")), encoding="utf-8")
