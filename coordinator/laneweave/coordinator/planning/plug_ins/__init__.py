"""Planners of users: entry points of the group `laneweave.planners`.

`registry.PLANNERS` has all solvers by name. A plug-in runs in a process of its own (`process`), and
`search.PluggedInSearch` checks its plans. Imported by `solve`, which offers both as solvers.
"""
