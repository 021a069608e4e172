"""Sweeps: methods x volumes x seeds, each point a run in a process of its own.

methods          the labels: a method and the settings that it is run with
points           one run of a sweep, and all of them
run_method       scenario, method, folder -> Outcome, in this process
point_process    the process of one point
execution        starts such a process, waits for it, ends it
local_workers    many of them on this machine
dask_workers     many of them on a Dask cluster
folder           what is finished, what is recorded, results.parquet
conduct          all of it together, with progress
"""
