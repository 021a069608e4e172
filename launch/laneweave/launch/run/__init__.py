"""Runs: as processes, over the simulated network, or with a reference method.

Entry points: `local_run.LocalRun`, `simulated_run.SimulatedRun` and `reference_run.ReferenceRun`,
whose `run` returns an `outcome.Outcome`. Imported by `cli`, `sweep`, `bench` and `fault_search`;
imports `faults`, `observe` and `report`.
"""
