"""What all processes share; imports no other package of laneweave.

Start with `wire.messages` (what is sent) and `runtime.node` (how a core is driven).
"""
