"""The solver for large formations: branch and bound over a Lagrangian relaxation.

Entry point: `branching`. `lagrangian_bound` computes lower bounds; `negotiation` finds path sets
early. Modules named `*_kernel` are compiled with numba. Imported by `planning.solve`.
"""
