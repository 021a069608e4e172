"""Driving: how a vehicle follows its cell or its move.

Entry point: `driver.Driver`. `trajectory` plans moves between cells, `reference` puts them on the
road clock, `tracker` follows them (`program`: the quadratic program, `regulator`: its unconstrained
solution), `surroundings` predicts neighbours. `qp` is the only module that imports osqp. No I/O;
imported by `agents.core`, `agents.process` and launch.
"""
