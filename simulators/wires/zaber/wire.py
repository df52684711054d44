"""Simulated Zaber rotary stage on its wire: ASCII packets in, replies and alerts out, and faults on request.

One device with one rotary axis that turns the sample; one of its digital outputs is cabled to the camera. Behaviour
from what the vendor's own library sends and accepts; where that tells nothing, as said in the modules behind.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Set
from enum import StrEnum

from drivers.clock import Clock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.zaber.axis import Rejected
from simulators.wires.zaber.device import NOTHING, ZaberDevice
from simulators.wires.zaber.packets import Command, Malformed, PacketReader, frame


class Fault(StrEnum):
    """What can happen to a reply on its way."""

    SILENT = "silent"
    WRONG_CHECKSUM = "wrong checksum"
    TRUNCATED = "truncated"
    NOISE = "noise before it"
    ALERT = "an alert before it"
    OTHER_ID = "somebody else's id"
    AGAIN = "the device asks to repeat"


class ZaberController:
    """Bytes in by `receive`, bytes out by `transmit`. Safe from several threads.

    Args:
        line: what digital output `output` (from 1) is wired to; it also learns the sample's true angle.
        counts_per_turn: microsteps for 2π.
        active_high: which edge of that output the camera takes for a pulse.
        address: of the device in the chain.
        firmware: version; triggers came with 7.06.
        can_schedule: it knows `io set do N V schedule MS W`; can_chain: an action may enable another trigger.
        identity: the name of the setting with the device's identity number: "device.id" or "deviceid".
        low, high: travel limits in microsteps.
        homed: it knows its reference; without it stands WR.
        stall_at, switch_at: counts at which a move that would pass ends: stalled (FS), at a limit switch (WL, FE).
        latency: s from a trigger's condition to its actions.
        fires_when_enabled: a distance trigger fires where it is enabled, too.
        lost: trigger pulses (from 0, since power-on) that never reach the line.
        faults: reply (from 0, since power-on) -> what happens to it.
        echo: the line sends the host its own bytes back.
    """

    def __init__(
        self,
        clock: Clock,
        line: TriggerLine,
        *,
        counts_per_turn: int = 384_000,
        output: int = 1,
        active_high: bool = True,
        address: int = 1,
        firmware: str = "7.38",
        can_schedule: bool = True,
        can_chain: bool = True,
        identity: str = "device.id",
        low: int = -2_000_000_000,
        high: int = 2_000_000_000,
        homed: bool = True,
        stall_at: int | None = None,
        switch_at: int | None = None,
        latency: float = 0.0,
        fires_when_enabled: bool = False,
        lost: Set[int] = frozenset(),
        faults: Mapping[int, Fault] | None = None,
        echo: bool = False,
    ) -> None:
        self.clock = clock
        self.replies = 0
        self.device = ZaberDevice(
            clock,
            line,
            counts_per_turn=counts_per_turn,
            output=output,
            active_high=active_high,
            firmware=firmware,
            can_schedule=can_schedule,
            can_chain=can_chain,
            identity=identity,
            low=low,
            high=high,
            homed=homed,
            stall_at=stall_at,
            switch_at=switch_at,
            latency=latency,
            fires_when_enabled=fires_when_enabled,
            lost=lost,
        )
        self._address, self._echo = address, echo
        self._faults: Mapping[int, Fault] = {} if faults is None else faults
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
        """Bytes for the host that were not taken yet."""
        with self._lock:
            self._settle()
            out = bytes(self._out)
            self._out.clear()
            return out

    def alert(self) -> None:
        """Send an alert that nobody asked for."""
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
