"""The rolling operation: all vehicles on the road are replanned in every slot.

Entry point: `operation.RollingOperation` (the leader's side). `transfer` is one ballot, which moves
vehicles and transfers cells, `ownership` derives the owners of cells from states, `observed` stores
the received states, `known_road` is what the planner gets of them, `checked_planner` plans for the
scenario's road. Imported by `core` only.
"""
