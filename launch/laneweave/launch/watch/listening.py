"""The address of the live page."""

from __future__ import annotations

import socket
from typing import Final

from laneweave.protocol.errors import BadInputError

LISTEN_RULE: Final = "HOST:PORT, an address of this machine; port 0: any free port"


def open_socket(listen: str, option: str = "--listen") -> socket.socket:
    """Return a socket that listens at an address, which was given by an option.

    Raises:
        BadInputError: the address is malformed or cannot be used.
    """
    host, colon, port = listen.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise BadInputError(option, listen, LISTEN_RULE)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, int(port)), family=family)
    except (OSError, UnicodeError) as error:
        allowed = f"{LISTEN_RULE} ({getattr(error, 'strerror', None) or error})"
        raise BadInputError(option, listen, allowed) from error


def address_of(listener: socket.socket) -> str:
    """Return the URL of the page."""
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"
