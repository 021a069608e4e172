"""What finished runs and sweeps left on disk.

Entry points: `runs.single_run` and `runs.runs_of` (folders of runs and sweeps), `results` (one
table over runs, aggregated over seeds), `trajectories.read_tracks`. Imported by `sweep`, `watch`,
`report`, `run`, `cli` and the benchmarks.
"""
