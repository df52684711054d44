"""Serving the page: on this machine alone unless told otherwise, with new tokens at each start."""

from __future__ import annotations

import asyncio
import ipaddress
import secrets
import socket
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from threading import Event

import psutil
import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.h11_impl import H11Protocol

from beamline.core.errors import ConfigError
from beamline.features.page.app import Access, Strangers

TOKEN_WITHIN = 5.0  # s in which a connection shows a token


@dataclass(frozen=True)
class Addresses:
    """Addresses for a browser: to look, and to act as well (None: not allowed)."""

    look: str
    act: str | None


def open_port(bind: str, port: int) -> socket.socket:
    """A listening socket at a port, or at the next free one of the ten after it.

    Raises:
        ConfigError: not an address of this machine, or no port is free.
    """
    try:
        family = socket.AF_INET6 if ipaddress.ip_address(bind).version == 6 else socket.AF_INET
    except ValueError as error:
        raise ConfigError(f"--bind is {bind!r}; expected an IP address of this machine, such as 127.0.0.1.") from error
    reason = ""
    for candidate in range(port, min(port + 10, 65536)):
        try:
            return socket.create_server((bind, candidate), family=family)
        except OSError as error:
            reason = error.strerror or str(error)
    raise ConfigError(f"The page finds no port at {bind} from {port} on ({reason}). Name another by --port.")


class _Server(uvicorn.Server):
    """A server that says when it ends, so that feeds of open pages end by themselves."""

    def __init__(self, config: uvicorn.Config, ended: Event) -> None:
        super().__init__(config)
        self._ended = ended

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._ended.set()
        await super().shutdown(sockets)


def _connections(strangers: Strangers) -> type[asyncio.Protocol]:
    """The protocol of a connection: a token comes within `TOKEN_WITHIN`. That of h11 reads 16 kB before a request."""

    class Connection(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            strangers.enter(self.client, transport.abort)
            self.loop.call_later(TOKEN_WITHIN, strangers.end, self.client)

        def connection_lost(self, exc: Exception | None) -> None:
            strangers.leave(self.client)
            super().connection_lost(exc)

    return Connection


class PageServer:
    """A server bound to its port; `run` serves."""

    def __init__(self, app: Starlette, listening: socket.socket, access: Access) -> None:
        self._listening = listening
        root = f"http://{access.hosts[0]}/?token={access.look}"
        self.addresses = Addresses(root, None if access.act is None else f"{root}#act={access.act}")
        self._server = _Server(
            uvicorn.Config(
                app, log_level="warning", access_log=False, lifespan="off",
                timeout_graceful_shutdown=1, server_header=False, proxy_headers=False,
                http=_connections(access.strangers),
            ),
            access.ended,
        )  # fmt: skip

    def run(self) -> None:
        """Serve until `stop`, or Ctrl-C in the main thread."""
        with closing(self._listening):
            asyncio.run(self._server.serve(sockets=[self._listening]))

    def stop(self) -> None:
        """End `run`, from any thread."""
        self._server.should_exit = True


def start(app: Callable[[Access], Starlette], listening: socket.socket, *, control: bool = False) -> PageServer:
    """A server of an application, with new tokens.

    Args:
        control: allow verbs from the page, with the address for acting.
    """
    access = Access(_names(listening), act=secrets.token_hex(16) if control else None)
    return PageServer(app(access), listening, access)


def _names(listening: socket.socket) -> list[str]:
    """Names of the server at this socket for a browser, with the port; the first one is printed."""
    host, port = listening.getsockname()[:2]
    address = ipaddress.ip_address(host)
    if address.is_unspecified:
        addresses = {entry.address for entries in psutil.net_if_addrs().values() for entry in entries}
        numbers = sorted(each for each in addresses if each.count(".") == 3)
        names = [socket.gethostname(), "localhost", *numbers]
    else:
        names = [host, "localhost"] if address.is_loopback else [host]
    return [f"[{name}]:{port}" if ":" in name else f"{name}:{port}" for name in names]
