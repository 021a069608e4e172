"""The simulated world: whole runs in one process, in virtual time, with far more faults than occur.

`laneweave simulate` runs it for many seeds. The coordinators, the agents' cores, plan execution,
charge and caretakers are the real ones; light are only the road (`road`: bodies that move in
straight lines) and the driver (`driver`: no trajectories). `checker` watches the bodies and what
is said on the network; it shares no code with what it watches.
"""
