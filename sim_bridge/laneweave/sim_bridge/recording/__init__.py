"""The files of a run: trajectories, trips, events, ticks and the world's part of the summary.

Entry point: `run_record.RunRecord`; `recorder` writes the Parquet files. Imported by
`sim_bridge.core`, `baselines` and launch.
"""
