"""What crosses the network: messages, their keys and their encoding.

Entry points: `messages` (every message with units and the meaning of its loss), `topics` (the key
grammar), `codec` (MessagePack). Knows nothing of transports, nodes and configuration.
Any package may import it.
"""
