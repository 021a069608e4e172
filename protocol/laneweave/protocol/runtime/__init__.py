"""How a pure core is driven: events in, effects out, over any transport.

Entry points: `node.Core` (what a role implements), `node.Node` (joins one core to one transport),
`transport.Transport` (the interface to the network). Imports `wire` only; both transports and all
roles import it.
"""
