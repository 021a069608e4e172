"""Writes the parts of the documents that follow from the code: `python docs/generate.py`.

In a document a generated part stands between `<!-- begin NAME -->` and `<!-- end NAME -->`; a test
compares it with what this script would write.
"""

from __future__ import annotations

import json
import re
import sys
from functools import cache
from pathlib import Path

from laneweave.coordinator.leader_rules import LEADER_RULES, Phase
from laneweave.launch.simulation.profiles import PROFILES
from laneweave.protocol.transitions import markdown_table, mermaid_diagram
from laneweave.protocol.vehicle_rules import VEHICLE_RULES, Stage

DOCS = Path(__file__).resolve().parent
FOUND = DOCS / "evidence" / "planted-bugs-found.json"
"""What the random search found, as `tests/simulation/search_bugs.py` prints it."""


def _diagram(text: str) -> str:
    return f"```mermaid\n{text}\n```"


def _planted_bugs() -> str:
    """Return the table of planted bugs; the tests that use them are not a package."""
    sys.path.insert(0, str(DOCS.parent / "tests"))
    from planted_bugs import BUGS  # noqa: PLC0415

    found = json.loads(FOUND.read_text(encoding="utf-8"))
    lines = [
        "| planted bug | rule | what is broken | spoils the story | it ends with | random search |",
        "|---|---|---|---|---|---|",
    ]
    for bug in BUGS:
        end = "two vehicles in one cell" if bug.collides else "disorder, or a wait"
        seed = found.get(bug.name, "-")
        lines.append(f"| `{bug.name}` | {bug.rule} | {bug.text} | `{bug.story}` | {end} | {seed} |")
    return "\n".join(lines)


def _profiles() -> str:
    """Return the table of what `laneweave simulate --profile` takes."""
    lines = ["| `--profile` | what goes wrong |", "|---|---|"]
    lines += [f"| `{profile.name}` | {profile.text} |" for profile in PROFILES.values()]
    return "\n".join(lines)


@cache
def parts() -> dict[str, str]:
    """Return each generated part by its name."""
    return {
        "vehicle rules": markdown_table(VEHICLE_RULES),
        "vehicle phases": _diagram(mermaid_diagram(VEHICLE_RULES, Stage.FREE)),
        "leader rules": markdown_table(LEADER_RULES),
        "leader phases": _diagram(mermaid_diagram(LEADER_RULES, Phase.OBSERVING)),
        "planted bugs": _planted_bugs(),
        "profiles": _profiles(),
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
