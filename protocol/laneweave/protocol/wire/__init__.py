"""Messages, keys and encoding: the content of the network.

Entry points: `messages` (every message with units and the effect of its loss), `topics` (key
grammar), `codec` (MessagePack). Independent of transports, nodes and configuration. Any package may
import it.
"""
