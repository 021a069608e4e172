"""The runtime of pure cores: events in, effects out, over any transport.

Entry points: `node.Core` (implemented by each role), `node.Node` (connects a core to a transport),
`transport.Transport` (interface to the network). The only sub-package that it imports is `wire`;
both transports and all roles import it.
"""
