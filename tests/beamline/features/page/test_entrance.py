"""Entrance: a connection with the token is accepted, however many others came before and after it."""

import asyncio
import socket
from collections.abc import Callable
from contextlib import ExitStack, closing

import pytest

from beamline.features.page.serve import SILENT, STRANGERS, Entrance, open_port

TOKEN = b"0123456789abcdef"
ASKED = b"GET / HTTP/1.1\r\nCookie: splatline=" + TOKEN + b"\r\n\r\n"
STRANGE = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"


class _Heard(asyncio.Protocol):
    """A protocol that notes what it was sent."""

    def __init__(self, heard: list[bytes]) -> None:
        self._heard = heard

    def data_received(self, data: bytes) -> None:
        self._heard.append(data)


def heard_of(made: Callable[[Callable[[bytes], None]], None], until: Callable[[list[bytes]], bool]) -> list[bytes]:
    """What protocols were sent, after connections were made by a function that takes `connect(sent)`."""
    heard: list[bytes] = []

    async def served() -> None:
        with closing(open_port("127.0.0.1", 0)) as listening, ExitStack() as stack:
            entrance = stack.enter_context(closing(Entrance(listening, lambda: _Heard(heard), TOKEN)))
            assert entrance is not None

            def connect(sent: bytes) -> None:
                connection = stack.enter_context(socket.create_connection(listening.getsockname(), timeout=5))
                connection.sendall(sent)

            made(connect)
            async with asyncio.timeout(20):
                while not until(heard):
                    await asyncio.sleep(0.01)

    with asyncio.Runner(loop_factory=asyncio.SelectorEventLoop) as runner:
        runner.run(served())
    return heard


@pytest.mark.parametrize("other", [b"", STRANGE], ids=["silent", "strangers"])
def test_a_request_with_the_token_is_heard_first_among_several_hundred(other: bytes) -> None:
    def made(connect: Callable[[bytes], None]) -> None:
        for _ in range(3 * SILENT):
            connect(other)
        connect(ASKED)
        for _ in range(SILENT - 1):
            connect(other)

    assert ASKED in heard_of(made, lambda heard: ASKED in heard)


def test_strangers_are_heard_one_after_the_other_and_the_oldest_give_way() -> None:
    def made(connect: Callable[[bytes], None]) -> None:
        for n in range(2 * STRANGERS):
            connect(b"%d" % n)

    heard = heard_of(made, lambda heard: bool(heard) and heard[-1] == b"%d" % (2 * STRANGERS - 1))
    assert heard == [b"%d" % n for n in range(STRANGERS, 2 * STRANGERS)]


def test_one_that_speaks_late_is_heard_and_one_that_leaves_is_forgotten() -> None:
    heard: list[bytes] = []

    async def served() -> None:
        with (
            closing(open_port("127.0.0.1", 0)) as listening,
            closing(Entrance(listening, lambda: _Heard(heard), TOKEN)),
        ):
            with socket.create_connection(listening.getsockname(), timeout=5):
                await asyncio.sleep(0.05)
            with socket.create_connection(listening.getsockname(), timeout=5) as late:
                await asyncio.sleep(0.2)
                late.sendall(ASKED)
                async with asyncio.timeout(20):
                    while not heard:
                        await asyncio.sleep(0.01)

    with asyncio.Runner(loop_factory=asyncio.SelectorEventLoop) as runner:
        runner.run(served())
    assert heard == [ASKED]
