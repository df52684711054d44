"""Simulated Zaber rotary stage on its wire: ASCII packets in, replies and alerts out, and faults on request.

One device with one rotary axis that turns the sample; one of its digital outputs is cabled to the camera. Behaviour
follows the vendor's own library. Other modules of this folder say where it is from memory.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Self

from drivers.base.clock import Clock
from drivers.stages.zaber.settings import ZaberSettings
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.zaber.axis import Rejected, ZaberAxisBuild
from simulators.wires.zaber.device import NOTHING, DeviceBuild, ZaberDevice
from simulators.wires.zaber.packets import Command, Malformed, PacketReader, frame
from simulators.wires.zaber.triggers import OUTPUTS


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
        echo: the line sends the host its own bytes back.
        device: the device behind the wire.
    """

    address: int = 1
    faults: Mapping[int, Fault] = field(default_factory=dict)
    echo: bool = False
    device: DeviceBuild = field(default=DeviceBuild())

    @classmethod
    def matching(cls, settings: ZaberSettings) -> Self:
        if settings.output > OUTPUTS:
            raise ValueError(
                f"output: the simulated controller has no digital output {settings.output}; it has 1 to {OUTPUTS}"
            )
        device = DeviceBuild(
            output=settings.output,
            active_high=settings.wiring.active_high,
            can_schedule=not settings.toggle,
            can_chain=settings.triggers.chained,
            fires_when_enabled=settings.triggers.fires_when_enabled,
            axis=ZaberAxisBuild(settings.figures.counts_per_turn),
        )
        return cls(settings.device, device=device)

    def controller(self, clock: Clock, line: TriggerLine) -> ZaberController:
        return ZaberController(clock, line, self)


class ZaberController:
    """Bytes in by `receive`, bytes out by `transmit`. Safe from several threads.

    Args:
        line: the cable in the build's digital output; it also learns the sample's true angle.
    """

    def __init__(self, clock: Clock, line: TriggerLine, build: ZaberBuild) -> None:
        self.clock = clock
        self.replies = 0
        self.device = ZaberDevice(clock, line, build.device)
        self._address, self._echo, self._faults = build.address, build.echo, build.faults
        self._reader = PacketReader()
        self._out = bytearray()
        self._lock = threading.RLock()
        line.attach_angle(self._angle_at)

    def receive(self, data: bytes) -> None:
        """Bytes from the host, in pieces of any size."""
        with self._lock:
            if self._echo:
                self._out += data
            for packet in self._reader.feed(data):
                self._settle()
                command = packet.command if isinstance(packet, Malformed) else packet
                if command.address in (0, self._address):
                    self._answer(command, packet.reason if isinstance(packet, Malformed) else "")

    def transmit(self) -> bytes:
        """Bytes for the host that are not yet taken."""
        with self._lock:
            self._settle()
            out = bytes(self._out)
            self._out.clear()
            return out

    def output_is_high(self, number: int) -> bool:
        outputs = self.device.triggers.outputs
        return 1 <= number <= len(outputs) and bool(outputs[number - 1])

    def alert(self) -> None:
        """Send an alert without a command."""
        self._out += frame(f"!{self._address:02d} 1 {self._state()}", self.device.checksums)

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
        self._out += _spoilt(reply, fault)
        for text in information:
            self._out += frame(f"#{where} {text}", self.device.checksums)

    def _state(self) -> str:
        """BUSY or IDLE, and the gravest warning flag."""
        busy = self.device.axis.moving(self.clock.now())
        return f"{'BUSY' if busy else 'IDLE'} {next(iter(self.device.axis.warnings()), '--')}"

    def _angle_at(self, time: float) -> float:
        with self._lock:
            return self.device.axis.angle_at(time)


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
