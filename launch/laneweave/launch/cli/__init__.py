"""The command line `laneweave`: one module per group of commands.

Entry point: `main.main`. Commands import their dependencies when they run. Imported by the
installed script; `options` also by benchmarks/.
"""
