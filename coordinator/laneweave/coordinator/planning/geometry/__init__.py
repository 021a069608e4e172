"""Conflicts computed from the sizes and motions of vehicles.

Entry point: `conflict_table`. `settings` has sizes, times and clearances, `bodies` where a moving
body is. Imported by `planning.conflicts`.
"""
