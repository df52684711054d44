"""Zaber ASCII packets as a device reads and writes them: prefix numbers, checksums, replies, alerts.

From what the vendor's own library sends and accepts, and the test vectors of zproto; nothing is shared with the driver.
From memory, not confirmed: a wrong checksum gets no answer.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

LONGEST_PACKET = 80
"""Bytes of a packet; a longer one is ignored."""
LONGEST_WORD = 50
LINE_ENDS = re.compile(rb"[\r\n]+")


@dataclass(frozen=True)
class Command:
    """A whole command: address 0 is every device, axis 0 the device itself, `id` the text to be echoed or ""."""

    address: int
    axis: int
    id: str
    words: tuple[str, ...]


@dataclass(frozen=True)
class Malformed:
    """A packet that reached this device but has a wrong form and is refused."""

    command: Command
    reason: str


def lrc(body: bytes) -> str:
    """Two hex digits that bring the sum of all bytes to 0 mod 256."""
    total = 0
    for byte in body:
        total = (total + byte) & 0xFF
    return f"{-total & 0xFF:02X}"


def frame(text: str, checksum: bool) -> bytes:
    """A packet from the device: its type character, text, the checksum where wanted, CR LF."""
    tail = f":{lrc(text[1:].encode('ascii'))}" if checksum else ""
    return f"{text}{tail}\r\n".encode("ascii")


class PacketReader:
    """Bytes from the host, in pieces of any size, to commands. A packet with a wrong checksum, without `/`, too long or
    not ASCII is silently ignored."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> list[Command | Malformed]:
        self._bytes += data
        found: list[Command | Malformed] = []
        while (end := LINE_ENDS.search(self._bytes)) is not None:
            line = bytes(self._bytes[: end.start()])
            del self._bytes[: end.end()]
            if (packet := self._packet(line)) is not None:
                found.append(packet)
        if len(self._bytes) > LONGEST_PACKET:
            del self._bytes[: -LONGEST_PACKET - 1]  # too long already: the rest is dropped
        return found

    def _packet(self, line: bytes) -> Command | Malformed | None:
        if not line.startswith(b"/") or len(line) > LONGEST_PACKET or not line.isascii():
            return None
        body, colon, checksum = line[1:].partition(b":")
        if colon and checksum.decode("ascii").upper() != lrc(body):
            return None
        text = body.decode("ascii")
        command = _command(text)
        if command.id and not (command.id == "--" or int(command.id) <= 99):
            return Malformed(Command(command.address, command.axis, "", command.words), "BADMESSAGEID")
        if any(len(word) > LONGEST_WORD for word in command.words):
            return Malformed(command, "LONGWORD")
        return command


def _command(text: str) -> Command:
    """Numbers at the start are address, axis and id, as many as there are. The first other word begins the command.
    "--" in the third place means: no id."""
    words = text.split()
    numbers: list[str] = []
    while words and len(numbers) < 3 and (words[0].isdigit() or (len(numbers) == 2 and words[0] == "--")):
        numbers.append(words.pop(0))
    address, axis = (int(numbers[at]) if len(numbers) > at else 0 for at in (0, 1))
    return Command(address, axis, numbers[2] if len(numbers) > 2 else "", tuple(words))
