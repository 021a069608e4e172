"""Compiled solvers: branch and bound over a Lagrangian relaxation, and a joint search.

Entry points: `branching`, for formations of any size; `joint_search`, for few vehicles or few empty
cells, which TAPPA and branching use. `lagrangian_bound` computes lower bounds; `negotiation` finds
path sets early. Modules named `*_kernel` are compiled with numba. Imported by `planning.solve` and
`planning.paper`.
"""
