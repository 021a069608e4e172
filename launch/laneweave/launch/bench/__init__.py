"""`laneweave bench planner|tracker|runtime`: seeded benchmarks for users.

Imported by `cli` and by benchmarks/, which checks the goals of this repository.
"""
