"""The rolling operation: all vehicles on the road are planned anew in each slot.

Entry point: `operation.RollingOperation` (the leader's side). `transfer` is one ballot that moves
vehicles and transfers cells, `ownership` what a leader knows of who owns which cell, `observed` the
states that it has received, `planner` the planner of a scenario's road. Imported by `core` only.
"""
