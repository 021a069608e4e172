"""Sweeps over methods, volumes and seeds; each point is a run in a separate process.

Entry point: `sweep.run_sweep`, with points from `points.plan_points`, a `folder.SweepFolder`, and a
runner: `execution.run_locally`, or `dask_workers.run_on_dask` on a cluster. Imported by `cli` and
the evaluation in benchmarks/.
"""
