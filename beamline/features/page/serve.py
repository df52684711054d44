"""Web server for a run or a folder of runs. By default only this computer can reach it; each start makes new tokens.

The page of a folder is a table of its runs. The page of a run is below `/run/NUMBER/`.
"""

from __future__ import annotations

import asyncio
import ipaddress
import secrets
import select
import signal
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import psutil
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from beamline.core.errors import ConfigError, DataError
from beamline.features.page.app import KNOWN, Access, begins_with, guarded, page_routes
from beamline.page.run_files import Reader, watched
from beamline.scan.runs import HEAD, cells, describe, runs_in

SILENT, STRANGERS = 96, 32
"""Largest numbers of connections that have not sent anything, and of connections with requests without the token. If
there are more, the oldest is closed. Together with the connections that are served, they are fewer than the 256 files
that a process may open on macOS."""
# number of connections that wait in the system; number that are accepted before others are served
_QUEUE, _AT_ONCE = 1024, 128
_TURN = 0.01  # s between two connections without the token; an answer takes a millisecond or two
# s between two checks of connections that have not sent anything: after a new connection, and later
_SOON, _LATE = 0.002, 0.05
_HEAD = 65536  # number of bytes of a request in which the token is searched


class Entrance:
    """The listening socket of a page, until `close`. Requests with the token are served before all others.

    The event loop accepts only some hundred connections per second if each one becomes a protocol at once. Other
    connections wait in the queue of the operating system. If this queue is full, a connection is dropped, and the
    client tries again after one to three seconds. Here, accepting a connection is a single system call, so that
    thousands of connections per second are possible.

    Args:
        protocol: function that makes the protocol of a connection that is passed on. token: connections whose first
            bytes contain this token are passed on at once; other connections are passed on one after the other.
    """

    def __init__(self, listening: socket.socket, protocol: Callable[[], asyncio.Protocol], token: bytes) -> None:
        self._listening, self._protocol, self._token = listening, protocol, token
        self._loop = asyncio.get_running_loop()
        self._silent = list[socket.socket]()  # oldest first, like the connections without the token
        self._strangers = list[socket.socket]()
        self._look: asyncio.TimerHandle | None = None
        self._turn: asyncio.TimerHandle | None = None
        self._handed_on: set[asyncio.Task[None]] = set()
        listening.setblocking(False)
        listening.listen(_QUEUE)
        self._loop.add_reader(listening, self._accept)

    def close(self) -> None:
        """Accept no more connections, and close the waiting ones."""
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
            except (
                OSError
            ):  # the connection was reset, or the process cannot open more files: then a waiting connection is closed
                _close_oldest(self._silent, len(self._silent) - 1)
                break
        self._hear(_SOON)

    def _hear(self, soon: float) -> None:
        """Find the waiting connections that have sent something. Check again after this time, and later at longer
        intervals."""
        for connection in select.select(self._silent, (), (), 0)[0] if self._silent else ():
            self._silent.remove(connection)
            self._take(connection)
        _close_oldest(self._silent, SILENT)
        if self._look is not None:
            self._look.cancel()
        self._look = self._loop.call_later(soon, self._hear, min(2 * soon, _LATE)) if self._silent else None

    def _take(self, connection: socket.socket) -> None:
        """A connection with the token is passed on; a connection without it waits for its turn."""
        connection.setblocking(False)
        try:
            sent = connection.recv(_HEAD, socket.MSG_PEEK)
        except OSError:
            sent = b""
        if not sent:  # the other side has closed the connection
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
            with suppress(OSError):  # the connection was reset
                await self._loop.connect_accepted_socket(self._protocol, connection)

        task = self._loop.create_task(serve())
        self._handed_on.add(task)
        task.add_done_callback(self._handed_on.discard)


def _close_oldest(connections: list[socket.socket], most: int) -> None:
    """Close connections until this number is left."""
    while len(connections) > max(most, 0):
        connections.pop(0).close()


CONNECTIONS = 96
"""Largest number of open connections. If there are more, the oldest idle one is closed for a new one. A browser opens
six connections, and a process may open 256 files on macOS."""
_KNOWN_STAYS = 3600  # s without a request
OPEN_RUNS = 8
"""Number of runs whose files stay open although nobody watches them."""


@dataclass
class _Opened:
    reader: Reader
    app: ASGIApp
    requests: int = 0  # requests that are being answered; the feed of an open page is one of them


class RunBrowser:
    """The runs of a folder. They are numbered, so that no name from a client reaches the file system.

    Args:
        own: runs of the program to which this page belongs, the newest one last. More runs may be added. The table
            links to the newest of these runs. Only these runs can be controlled.
    """

    def __init__(self, folder: Path, own: Sequence[Path] = ()) -> None:
        self._folder, self._own, self._lock = folder, own, threading.Lock()
        self._access = Access(())
        self._numbers: dict[Path, int] = {}
        self._opened: dict[tuple[int, bool], _Opened] = {}  # by number, and whether the run is one of `own`

    def close(self) -> None:
        for opened in self._opened.values():
            opened.reader.close()

    def app(self, access: Access) -> Starlette:
        """The application. Users with the control token can control its own runs on their pages."""
        self._access = access
        routes = [Route("/api/runs", self.table), Mount("/run/{number:number}", self.page_of)]
        return guarded("runs.html", routes, access)

    def table(self, request: Request) -> Response:
        """Head and rows of the table, newest run first. Each row has the number of its page and the next step. The
        number of the newest run of `own` is returned, too."""
        with self._lock:
            rows = [
                {"number": self._numbers.setdefault(run, len(self._numbers)), "cells": cells(it), "next": it.next_step}
                for run in runs_in(self._folder)
                for it in [describe(run)]
            ]
        newest = self._numbers.get(self._own[-1]) if self._own else None
        return JSONResponse({"folder": self._folder.resolve().name, "head": HEAD, "rows": rows, "newest": newest})

    async def page_of(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request to the page of a run."""
        opened = self._open(scope["path_params"]["number"])
        opened.requests += 1
        try:
            await opened.app(scope, receive, send)
        finally:
            opened.requests -= 1

    def _open(self, number: int) -> _Opened:
        runs = list(self._numbers)  # by number; a copy, because `table` adds to it in another thread
        if number >= len(runs):
            raise DataError(f"This page has no run {number}.")
        opened = number, (is_own := runs[number] in self._own)
        if opened not in self._opened:
            unused = [n for n, opened in self._opened.items() if not opened.requests]
            for n in unused[: len(self._opened) + 1 - OPEN_RUNS]:
                self._opened.pop(n).reader.close()
            reader = Reader(watched(runs[number]))
            routes = page_routes(reader, self._access if is_own else replace(self._access, act=None), lambda line: None)
            self._opened[opened] = _Opened(reader, begins_with("index.html", routes))
        return self._opened[opened]


@dataclass(frozen=True)
class Addresses:
    """Addresses for a browser: one to watch the scan, and one that also allows control (None: control is not
    allowed)."""

    look: str
    act: str | None


def open_port(bind: str, port: int) -> socket.socket:
    """A listening socket at a port, or at the next free port among the ten after it.

    Raises: ConfigError: the address is not one of this machine, or no port is free.
    """
    try:
        family = socket.AF_INET6 if ipaddress.ip_address(bind).version == 6 else socket.AF_INET
    except ValueError as error:
        raise ConfigError(f"--bind is {bind!r}; expected an IP address of this computer, such as 127.0.0.1.") from error
    reason = ""
    for candidate in range(port, min(port + 10, 65536)):
        try:
            return socket.create_server((bind, candidate), family=family)
        except OSError as error:
            reason = error.strerror or str(error)
    raise ConfigError(f"No free port was found at {bind}, from {port} on ({reason}). Choose another with --port.")


class _Connection(H11Protocol):
    """A connection that may be closed for a newer one while it is idle. So a client that sends nothing cannot keep
    others out.

    A connection that has sent the token stays open for an hour, and is closed last. So a command to stop the scan needs
    no new connection, which may take seconds if thousands of others are being made.
    """

    @property
    def known(self) -> bool:
        return self.cycle is not None and KNOWN in self.cycle.scope

    def on_response_complete(self) -> None:
        self.timeout_keep_alive = _KNOWN_STAYS if self.known else self.config.timeout_keep_alive
        super().on_response_complete()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.since = time.monotonic()
        open_connections: list[Any] = [each for each in self.connections if not each.transport.is_closing()]
        idle = [each for each in open_connections if each.cycle is None or each.cycle.response_complete]
        if idle and len(open_connections) > CONNECTIONS:
            min(idle, key=attrgetter("known", "since")).transport.abort()


class _Server(uvicorn.Server):
    """A server behind an entrance. It announces its end, so that the feeds of open pages end by themselves."""

    def __init__(self, config: uvicorn.Config, access: Access) -> None:
        super().__init__(config)
        self._access, self._ignored = access, signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        self._entrances: list[Entrance] = []

    def handle_exit(self, sig: int, frame: Any) -> None:
        # for example in a process that a script started in the background
        if sig != signal.SIGINT or not self._ignored:
            super().handle_exit(sig, frame)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup([])
        protocol = partial(_Connection, self.config, self.server_state, self.lifespan.state)
        self._entrances = [Entrance(each, protocol, self._access.look.encode()) for each in sockets or ()]

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._access.ended.set()
        for entrance in self._entrances:
            entrance.close()
        await super().shutdown(sockets)


class PageServer:
    """A server that is bound to its port. `run` starts serving."""

    def __init__(self, app: Starlette, listening: socket.socket, access: Access) -> None:
        self._listening = listening
        root = f"http://{access.hosts[0]}/?token={access.look}"
        self.addresses = Addresses(root, None if access.act is None else f"{root}#act={access.act}")
        self._server = _Server(
            uvicorn.Config(
                app, log_level="warning", access_log=False, lifespan="off", http=_Connection,
                timeout_graceful_shutdown=1, server_header=False, proxy_headers=False,
            ),
            access,
        )  # fmt: skip

    def run(self) -> None:
        """Serve until `stop`, or Ctrl-C in the main thread."""
        # the default event loop of Windows cannot wait until a connection has sent something
        selecting = asyncio.SelectorEventLoop
        with closing(self._listening), asyncio.Runner(loop_factory=selecting) as runner:
            runner.run(self._server.serve(sockets=[self._listening]))

    def stop(self) -> None:
        """End `run`, from any thread."""
        self._server.should_exit = True


def start(app: Callable[[Access], Starlette], listening: socket.socket, *, control: bool = False) -> PageServer:
    """Make a server for an application, with new tokens.

    Args:
        control: allow commands from the page, at the address for control.
    """
    access = Access(_names(listening), act=secrets.token_hex(16) if control else None)
    return PageServer(app(access), listening, access)


def _names(listening: socket.socket) -> list[str]:
    """Names, with the port, under which a browser can reach the server at this socket. The first name is printed."""
    host, port = listening.getsockname()[:2]
    address = ipaddress.ip_address(host)
    if address.is_unspecified:
        addresses = {entry.address for entries in psutil.net_if_addrs().values() for entry in entries}
        numbers = sorted(each for each in addresses if each.count(".") == 3)
        names = [socket.gethostname(), "localhost", *numbers]
    else:
        names = [host, "localhost"] if address.is_loopback else [host]
    return [f"[{name}]:{port}" if ":" in name else f"{name}:{port}" for name in names]
