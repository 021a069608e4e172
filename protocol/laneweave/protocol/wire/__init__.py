"""Messages, keys and encoding: what the network carries.

Entry points: `messages` (every message with units and the effect of its loss), `topics` (key
grammar), `codec` (MessagePack). Independent of transports, nodes and configuration. Any package may
import it.
"""
