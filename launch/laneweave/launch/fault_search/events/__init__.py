"""Fault events and lasting faults of a run.

Entry point: `faults.RandomFaults`, which applies events to the processes, network and messages of a
run.
"""
