"""A network inside one process, in virtual time, with seeded faults.

Entry point: `network.SimulatedNetwork`. Used by tests, by the fault search and by
`laneweave run --transport simulated`.
"""
