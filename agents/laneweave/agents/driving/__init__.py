"""How a vehicle drives: reference trajectories, tracking by quadratic programs, neighbours.

Entry point: `driver.Driver`. `reference` plans trajectories between cells, `tracker` follows them,
`qp` is the only module that imports osqp. Pure; imported by `agents.core`.
"""
