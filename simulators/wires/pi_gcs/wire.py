"""Simulated PI GCS 2.0 controller (C-863 class), the wire: converts bytes to commands of its one axis, and its
replies to bytes.

A command line ends with LF (CR is ignored, case does not matter) and is one item; single control bytes act at once.
Settings are not answered. The error register keeps the last error; ERR? reads and clears it. An unknown query is not
answered, either. In a reply of several lines all but the last end with SPACE LF.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Set
from dataclasses import dataclass, field
from typing import Self

from drivers.base.clock import Clock
from drivers.stages.pi_gcs.settings import PiGcsSettings
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.pi_gcs.axis import GcsAxis, GcsError, PiAxisBuild
from simulators.wires.pi_gcs.commands import COMMANDS, SINGLE, PiGcsBox
from simulators.wires.pi_gcs.output import PiOutput
from simulators.wires.wire import BytesWire

OUTPUTS = 4
LONGEST_LINE = 256

Spoil = Callable[[int, bytes], bytes]


def _degrees(angle: float) -> float:
    """Degrees as the driver writes them: with 12 decimals."""
    return round(math.degrees(angle), 12)


@dataclass(frozen=True)
class PiGcsBuild:
    """Properties of the simulated controller, and its faults.

    Attributes:
        axis: identifier of the axis.
        output: the digital output that the trigger cable is in, from 1.
        latency: time in s until a reply can be read.
        unknown: commands (like "ACC" or "TMN?") that this model does not know.
        spoil: damages replies: (number since power-on, bytes) -> the bytes that arrive.
        specimen: the axis, and its faults.
    """

    axis: str = "1"
    output: int = 1
    latency: float = 0.0
    unknown: Set[str] = frozenset()
    spoil: Spoil = lambda number, reply: reply
    specimen: PiAxisBuild = field(default=PiAxisBuild())

    @classmethod
    def matching(cls, settings: PiGcsSettings) -> Self:
        if settings.trigger_line > OUTPUTS:
            raise ValueError(
                f"trigger_line: the simulated controller has no digital output {settings.trigger_line}; it has 1 to "
                f"{OUTPUTS}"
            )
        specimen = PiAxisBuild(
            counts_per_turn=settings.counts_per_turn,
            low=_degrees(settings.low) - 1,
            high=_degrees(settings.high) + 1,
            first_pulse=settings.first_pulse,
            pulse_width=settings.firmware_pulse,
            rising=settings.active_high,
            max_velocity=_degrees(settings.max_speed),
            max_acceleration=_degrees(settings.acceleration),
        )
        return cls(settings.axis, settings.trigger_line, specimen=specimen)

    def controller(self, clock: Clock, line: TriggerLine) -> PiGcsController:
        return PiGcsController(clock, line, self)


class PiGcsController(BytesWire):
    """The controller behind the wire.

    Args:
        line: the cable in the build's output; it also learns the sample's true angle.
    """

    def __init__(self, clock: Clock, line: TriggerLine, build: PiGcsBuild) -> None:
        super().__init__(clock, build.latency)
        self.replies = 0
        outputs = {number: PiOutput(axis=build.axis) for number in range(1, OUTPUTS + 1)}
        self.box = PiGcsBox(build.axis, GcsAxis(clock, line, build.specimen, outputs[build.output]), outputs)
        self._unknown, self._spoil = build.unknown, build.spoil
        self._turns(line, self.box.axis.angle_at)

    def _take(self, data: bytes) -> None:
        for byte in data:
            if byte == 0x0A:
                line, self._in = bytes(self._in), bytearray()
                self._do_line(line)
            elif byte in SINGLE:
                self._answer(SINGLE[byte](self.box))
            elif byte != 0x0D and len(self._in) <= LONGEST_LINE:
                self._in.append(byte)

    def output_is_high(self, number: int) -> bool:
        return self.box.levels.get(number, False)

    def _do_line(self, line: bytes) -> None:
        words = line.decode("cp1252", errors="replace").split()
        if not words:
            return
        command, arguments = words[0].upper(), words[1:]
        try:
            if len(line) > LONGEST_LINE:
                raise GcsError(3)
            action = None if command in self._unknown else COMMANDS.get(command)
            if action is None:
                raise GcsError(2)
            self.box.axis.catch_up()
            self._answer(action(self.box, arguments))
        except GcsError as error:
            self.box.axis.error = error.code

    def _answer(self, reply: list[str] | None) -> None:
        if reply is None:
            return
        number, self.replies = self.replies, self.replies + 1
        self._send(self._spoil(number, (" \n".join(reply) + "\n").encode("cp1252")))
