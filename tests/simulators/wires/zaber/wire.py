"""Simulated Zaber rotary stage behind its wire: it receives ASCII packets, sends replies and alerts, and has faults on
request.

One device with one rotary axis that turns the sample; one of its digital outputs is cabled to the camera. Behaviour
follows the vendor's own library, packets also the test vectors of zproto; nothing is shared with the driver. From
memory: a wrong checksum gets no answer. Other modules of this folder say what else is from memory.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Self

from drivers.base.clock import Clock
from drivers.stages.zaber.settings import ZaberSettings
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.wire import BytesWire
from tests.simulators.wires.zaber.axis import Rejected, ZaberAxisBuild
from tests.simulators.wires.zaber.device import NOTHING, DeviceBuild, ZaberDevice
from tests.simulators.wires.zaber.triggers import OUTPUTS

LONGEST_PACKET = 80  # Bytes of a packet; a longer one is ignored
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
    return f"{-sum(body) & 0xFF:02X}"


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
        packets: list[Command | Malformed] = []
        while (end := LINE_ENDS.search(self._bytes)) is not None:
            line = bytes(self._bytes[: end.start()])
            del self._bytes[: end.end()]
            if (packet := self._packet(line)) is not None:
                packets.append(packet)
        if len(self._bytes) > LONGEST_PACKET:
            del self._bytes[: -LONGEST_PACKET - 1]  # too long already: the rest is dropped
        return packets

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


class Fault(StrEnum):
    """A fault of a reply on its way."""

    SILENT = "silent"
    WRONG_CHECKSUM = "wrong checksum"
    TRUNCATED = "truncated"
    NOISE = "noise before it"
    ALERT = "an alert before it"
    OTHER_ID = "somebody else's id"
    AGAIN = "the device asks to repeat"


@dataclass(frozen=True)
class ZaberBuild:
    """How the controller is built, and its faults.

    Attributes:
        address: of the device in the chain.
        faults: reply (from 0, since power-on) -> what happens to it.
        device: the device behind the wire.
    """

    address: int = 1
    faults: Mapping[int, Fault] = field(default_factory=dict)
    device: DeviceBuild = field(default=DeviceBuild())

    @classmethod
    def matching(cls, settings: ZaberSettings) -> Self:
        if settings.output > OUTPUTS:
            raise ValueError(
                f"output: the simulated controller has no digital output {settings.output}; it has 1 to {OUTPUTS}"
            )
        device = DeviceBuild(
            output=settings.output,
            active_high=settings.active_high,
            can_schedule=not settings.toggle,
            can_chain=settings.chained,
            fires_when_enabled=settings.fires_when_enabled,
            axis=ZaberAxisBuild(settings.counts_per_turn),
        )
        return cls(settings.device, device=device)

    def controller(self, clock: Clock, line: TriggerLine) -> ZaberController:
        return ZaberController(clock, line, self)


class ZaberController(BytesWire):
    """The device behind the wire.

    Args:
        line: the cable in the build's digital output; it also learns the sample's true angle.
    """

    def __init__(self, clock: Clock, line: TriggerLine, build: ZaberBuild) -> None:
        super().__init__(clock)
        self.replies = 0
        self.device = ZaberDevice(clock, line, build.device)
        self._address, self._faults = build.address, build.faults
        self._reader = PacketReader()
        self._turns(line, self.device.axis.angle_at)

    def _take(self, data: bytes) -> None:
        for packet in self._reader.feed(data):
            self._settle()
            command = packet.command if isinstance(packet, Malformed) else packet
            if command.address in (0, self._address):
                self._answer(command, packet.reason if isinstance(packet, Malformed) else "")

    def transmit(self) -> bytes:
        with self._lock:
            self._settle()
            return super().transmit()

    def output_is_high(self, number: int) -> bool:
        outputs = self.device.triggers.outputs
        return 1 <= number <= len(outputs) and bool(outputs[number - 1])

    def alert(self) -> None:
        """Send an alert without a command."""
        self._send(frame(f"!{self._address:02d} 1 {self._state()}", self.device.checksums))

    def _settle(self) -> None:
        if self.device.settle() and self.device.alerts:
            self.alert()

    def _answer(self, command: Command, reason: str) -> None:
        flag, data, before = "OK", NOTHING, self._state()
        try:
            if reason or command.axis > 1:
                raise Rejected(reason or "BADAXIS")
            if self._faults.get(self.replies) is Fault.AGAIN:
                raise Rejected("AGAIN")
            information = self.device.information(command.words)
            if not information:
                data = self.device.do(command.axis, command.words)
        except Rejected as rejected:
            flag, data, information = "RJ", rejected.reason, []
        fault, self.replies = self._faults.get(self.replies), self.replies + 1
        if fault is Fault.ALERT:
            self.alert()
        identity = "42" if fault is Fault.OTHER_ID else command.id
        where = f"{self._address:02d} {command.axis}{' ' if identity else ''}{identity}"
        # A position read just before the end of a move must not go with IDLE.
        state = before if command.words[:1] == ("get",) else self._state()
        reply = frame(f"@{where} {flag} {state} {data}", self.device.checksums)
        self._send(_spoilt(reply, fault))
        for text in information:
            self._send(frame(f"#{where} {text}", self.device.checksums))

    def _state(self) -> str:
        """BUSY or IDLE, and the gravest warning flag."""
        busy = self.device.axis.moving(self.clock.now())
        return f"{'BUSY' if busy else 'IDLE'} {next(iter(self.device.axis.warnings()), '--')}"


def _spoilt(reply: bytes, fault: Fault | None) -> bytes:
    if fault is Fault.SILENT:
        return b""
    if fault is Fault.TRUNCATED:
        return reply[: len(reply) // 2]
    if fault is Fault.NOISE:
        return b"\xfe\x00" + reply
    if fault is Fault.WRONG_CHECKSUM:
        return reply.replace(b"0", b"8", 1)
    return reply
