"""Conflicts computed from the sizes and motions of bodies.

Entry points: `BodyGeometry` in `bodies` (sizes, times, clearances), `conflict_table` in the module
of that name. Imported by `planning.request`. Imports `planning.conflicts` only, for the types.
"""
