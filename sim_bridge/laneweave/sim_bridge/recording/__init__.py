"""The files of a run: trajectories, trips, events, ticks and the summary.

Entry point: `run_record.RunRecord`. Imported by `sim_bridge.core`, `baselines` and launch.
"""
