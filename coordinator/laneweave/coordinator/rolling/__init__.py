"""The rolling operation: the whole stream is planned anew in each slot.

Entry points: `control.StreamControl` (the leader's side), `ballot` (one transfer of cells).
Imported by `coordinator.core`.
"""
