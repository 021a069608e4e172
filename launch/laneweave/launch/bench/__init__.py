"""`laneweave bench planner|tracker|runtime`: seeded benchmarks for users.

Imported by `cli.bench_command`. Benchmarks of this repository's own goals are in benchmarks/.
"""
