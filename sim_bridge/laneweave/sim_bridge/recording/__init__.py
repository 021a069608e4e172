"""What a run leaves behind: trajectories, trips, events and the world's part of the summary.

Entry points: `recorder.Recorder`, `run_record.RunRecord`. Imported by `sim_bridge.core`,
`baselines` and launch.
"""
