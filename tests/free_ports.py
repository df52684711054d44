"""Free ports for test servers."""

from __future__ import annotations

import os
import socket

FIRST_PORT, LAST_PORT = 20_000, 32_000
_GIVEN = set[int]()


def free_ports(n: int) -> list[int]:
    """Ports that are free for TCP and UDP, below the range that the system gives to clients.

    So no client takes one of them before it is used. Processes of tests start at different ports.
    """
    ports = list[int]()
    for i in range(LAST_PORT - FIRST_PORT):
        port = FIRST_PORT + (16 * os.getpid() + i) % (LAST_PORT - FIRST_PORT)
        if port not in _GIVEN and all(map(_is_free, (port, port), (socket.SOCK_DGRAM, socket.SOCK_STREAM))):
            ports.append(port)
        if len(ports) == n:
            _GIVEN.update(ports)
            return ports
    raise OSError("no port is free")


def _is_free(port: int, kind: int) -> bool:
    with socket.socket(socket.AF_INET, kind) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True
