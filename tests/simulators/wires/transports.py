"""Transports: any simulated device on a TCP port or a pseudo-terminal, for drivers and programs of any kind.

The device must run on a real clock. Leaving the context pulls the plug: who still holds the port finds it gone.
"""

from __future__ import annotations

import os
import select
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from simulators.wires.wire import Wire

POLL = 1e-3
"""s between looks for bytes that the device sends unasked, or late."""
CHUNK = 4096
LOST_BEYOND = 1 << 16
"""Bytes that nobody takes are lost once there are more than this, as on a line without flow control."""


@contextmanager
def serve_tcp(wire: Wire, host: str = "127.0.0.1", port: int = 0) -> Iterator[str]:
    """Serve `wire` to one client after another; yields the URL that pyserial opens. Port 0 takes a free one."""
    with socket.create_server((host, port)) as server, _running(lambda stop: _accept(wire, server, stop)):
        yield f"socket://{host}:{server.getsockname()[1]}"


@contextmanager
def serve_pty(wire: Wire) -> Iterator[str]:
    """Serve `wire` on a pseudo-terminal; yields its path.

    Raises:
        OSError: Windows has none.
    """
    if sys.platform == "win32":
        raise OSError("Windows has no pseudo-terminals that pyserial opens; use serve_tcp")
    import tty

    master, slave = os.openpty()  # the slave stays open: else the master fails whenever a client closes
    try:
        tty.setraw(slave)
        os.set_blocking(master, False)
        with _running(
            lambda stop: _carry(wire, master, lambda: os.read(master, CHUNK), lambda data: os.write(master, data), stop)
        ):
            yield os.ttyname(slave)
    finally:
        os.close(master)
        os.close(slave)


@contextmanager
def _running(work: Callable[[threading.Event], None]) -> Iterator[None]:
    """`work` in a thread until the context ends; what went wrong in it is raised there."""
    stop = threading.Event()
    with ThreadPoolExecutor(1, thread_name_prefix="simulated device") as pool:
        future = pool.submit(work, stop)
        try:
            yield
        finally:
            stop.set()
            future.result()


def _accept(wire: Wire, server: socket.socket, stop: threading.Event) -> None:
    while not stop.is_set():
        if not select.select([server], [], [], POLL)[0]:
            continue
        with server.accept()[0] as client:
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            _carry(wire, client.fileno(), lambda: client.recv(CHUNK), client.send, stop)


def _carry(
    wire: Wire, file: int, read: Callable[[], bytes], write: Callable[[bytes], int], stop: threading.Event
) -> None:
    """Bytes both ways until `stop`, or until the client has gone."""
    pending = b""
    while not stop.is_set():
        pending = (pending + wire.transmit())[-LOST_BEYOND:]
        readable, writable, _ = select.select([file], [file] if pending else [], [], POLL)
        try:
            if readable:
                if not (data := read()):
                    return
                wire.receive(data)
            if writable:
                pending = pending[write(pending) :]
        except BlockingIOError:
            continue
        except ConnectionError:
            return
