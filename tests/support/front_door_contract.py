"""A contract for import-linter: the five packages do not import what is offered to users."""

from __future__ import annotations

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, output

# import-linter loads this module before it searches for `laneweave`, and finds the folders of all
# five packages only if `laneweave` has been imported.
import laneweave

PACKAGES = ("agents", "coordinator", "launch", "protocol", "sim_bridge")


class FrontDoorContract(Contract):
    """The front door, `laneweave` and its modules besides the five packages, is for users only."""

    type_name = "front_door"

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:  # noqa: ARG002
        """Search the five packages for imports of the front door."""
        root = laneweave.__name__
        inner = {f"{root}.{package}" for package in PACKAGES}
        imports = [
            f"{importer} imports {module}"
            for module in [root, *sorted(graph.find_children(root) - inner)]
            for importer in sorted(graph.find_modules_that_directly_import(module))
            if any(importer == one or importer.startswith(f"{one}.") for one in inner)
        ]
        return ContractCheck(kept=not imports, metadata={"imports": imports})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Print the imports."""
        for line in check.metadata["imports"]:
            output.print_error(line)
