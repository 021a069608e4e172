"""Code that all processes share; imports no other package of laneweave.

Start with `wire.messages` (the messages) and `runtime.node` (how a core is driven).
"""
