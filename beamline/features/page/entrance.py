"""Entrance: accepts connections, and hands those on whose requests have the token before all others.

The event loop accepts some hundred connections a second if each becomes a protocol at once; the others wait in the
system, whose queue overflows, and a connection that it drops is tried again after a second or three. Here to accept is
a call of the system, so that thousands a second may come.
"""

from __future__ import annotations

import asyncio
import select
import socket
from collections.abc import Callable
from contextlib import suppress

SILENT, STRANGERS = 96, 32
"""Connections that wait until they send something, and with requests without the token: beyond these the oldest is
closed. With those that are served, they stay below the 256 files that a process of macOS may open."""
_QUEUE, _AT_ONCE = 1024, 128  # connections that wait in the system, and that are accepted before others are served
_TURN = 0.01  # s from one stranger to the next; an answer takes a millisecond or two
_SOON, _LATE = 0.002, 0.05  # s from one look at silent connections to the next: after a new one, and at last
_HEAD = 65536  # bytes of a request in which the token is looked for


class Entrance:
    """The listening socket of a page, until `close`.

    Args:
        protocol: makes the protocol of a connection that is handed on.
        token: connections whose first bytes have it are handed on at once, others one after the other.
    """

    def __init__(self, listening: socket.socket, protocol: Callable[[], asyncio.Protocol], token: bytes) -> None:
        self._listening, self._protocol, self._token = listening, protocol, token
        self._loop = asyncio.get_running_loop()
        self._silent = list[socket.socket]()  # oldest first, as the strangers
        self._strangers = list[socket.socket]()
        self._look: asyncio.TimerHandle | None = None
        self._turn: asyncio.TimerHandle | None = None
        self._handed_on: set[asyncio.Task[None]] = set()
        listening.setblocking(False)
        listening.listen(_QUEUE)
        self._loop.add_reader(listening, self._accept)

    def close(self) -> None:
        """Accept no more, and close those that wait."""
        self._loop.remove_reader(self._listening)
        for timer in (self._look, self._turn):
            if timer is not None:
                timer.cancel()
        for connection in (*self._silent, *self._strangers):
            connection.close()

    def _accept(self) -> None:
        for _ in range(_AT_ONCE):
            try:
                self._silent.append(self._listening.accept()[0])
            except BlockingIOError:
                break
            except OSError:  # it was reset, or no file is left to be opened: one that waits gives way
                _close_oldest(self._silent, len(self._silent) - 1)
                break
        self._hear(_SOON)

    def _hear(self, soon: float) -> None:
        """Take the connections that have sent something from those that are silent; look again so soon, then later."""
        for connection in select.select(self._silent, (), (), 0)[0] if self._silent else ():
            self._silent.remove(connection)
            self._take(connection)
        _close_oldest(self._silent, SILENT)
        if self._look is not None:
            self._look.cancel()
        self._look = self._loop.call_later(soon, self._hear, min(2 * soon, _LATE)) if self._silent else None

    def _take(self, connection: socket.socket) -> None:
        """With the token it is handed on, otherwise it waits for its turn."""
        connection.setblocking(False)
        try:
            sent = connection.recv(_HEAD, socket.MSG_PEEK)
        except OSError:
            sent = b""
        if not sent:  # the other side has closed it
            connection.close()
        elif self._token in sent:
            self._hand_on(connection)
        else:
            self._strangers.append(connection)
            _close_oldest(self._strangers, STRANGERS)
            if self._turn is None:
                self._turn = self._loop.call_later(_TURN, self._next_stranger)

    def _next_stranger(self) -> None:
        self._hand_on(self._strangers.pop(0))
        self._turn = self._loop.call_later(_TURN, self._next_stranger) if self._strangers else None

    def _hand_on(self, connection: socket.socket) -> None:
        async def serve() -> None:
            with suppress(OSError):  # it was reset
                await self._loop.connect_accepted_socket(self._protocol, connection)

        task = self._loop.create_task(serve())
        self._handed_on.add(task)
        task.add_done_callback(self._handed_on.discard)


def _close_oldest(connections: list[socket.socket], most: int) -> None:
    """Close connections until so many are left."""
    while len(connections) > max(most, 0):
        connections.pop(0).close()
