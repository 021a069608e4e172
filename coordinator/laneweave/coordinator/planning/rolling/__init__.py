"""The planner for rolling operation: in each slot, a path for every vehicle in the stream.

Entry point: `path_search`. `rolling_validator` checks its plans and shares no code with the search.
Imported by `coordinator.rolling`.
"""
