"""Driving: tracks the reference for a cell or a move.

Entry point: `driver.Driver`. `trajectory` plans moves between cells, `reference` places them in
road time, `tracker` tracks references (`tracking_problem`: the quadratic program, `regulator`: its
unconstrained solution), `surroundings` predicts gaps. Only `qp_solver` imports osqp. No I/O;
imported by `agents.core`, `agents.process` and launch.
"""
