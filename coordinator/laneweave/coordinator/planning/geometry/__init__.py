"""Conflicts computed from the sizes and motions of bodies.

Entry points: `swept_bodies.BodyGeometry` (sizes, times, clearances) and
`conflict_table.conflict_table`. Imported by `planning.request`.
"""
