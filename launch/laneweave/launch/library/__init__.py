"""What `import laneweave` offers: runs, plans and recorded runs from Python.

`runs.perform_run` is the one way to make a run; the command line uses it, too. Entry points:
`runs.run`, `plans.plan`, `recorded_run.load_run`. Imported by `cli` and by the front door.
"""
