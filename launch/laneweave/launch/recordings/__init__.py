"""Readers for the folders of finished runs and sweeps.

Entry points: `runs.single_run`, `runs.runs_of` (folders of runs and sweeps), `results_over_seeds`
(a table over runs, and its aggregation), `trajectories.read_tracks`, `events.read_events`.
Imported by `sweep`, `watch`, `report`, `cli` and benchmarks/.
"""
