"""The planner of the rolling operation: a path for every vehicle of the stream, in each slot.

Entry point: `path_search`. `rolling_validator` checks its plans and shares no code with the search.
Imported by `coordinator.rolling`.
"""
