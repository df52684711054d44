"""Simulated motor record: the fields of one axis, read and written by name, over a motor with whole steps.

From the record's reference (motor R7): a value written to VAL, HOMF, HOMR or STOP acts before the write is answered;
DMOV is 0 at once. The simulation shares only the form of a value with the driver. Without a network it has `sim://`
URLs; tests serve it over PVAccess and Channel Access.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.epics.channel import OPENERS, PvValue
from drivers.stages.epics.stage import EpicsSettings
from simulators.devices.motor import Ended, PulseMotor
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.wire import SCHEME, BytesWire, plugged

CHOICES = {".SPMG": ("Stop", "Pause", "Move", "Go"), ".SET": ("Use", "Set")}
DONE, AT_HIGH, PROBLEM, AT_LOW, HOMED = 0x2, 0x4, 0x200, 0x2000, 0x4000  # Bits of MSTA


@dataclass(frozen=True)
class EpicsBuild:
    """Configuration of the record, in its unit, and the positions of its switches.

    Attributes:
        counts_per_turn: number of steps for 360 of its unit.
        low, high: soft limits; both 0: there are no soft limits.
        fastest: VMAX; 0: no limit.
        home_at: step at which the home switch is.
        switch_at: step at which the upper limit switch ends a move.
        late: s from the write of VAL until DMOV becomes 0, as with a slow IOC.
        early: s before the end of a move at which DMOV becomes 1.
    """

    counts_per_turn: int = 360_000
    unit: str = "deg"
    low: float = 0.0
    high: float = 0.0
    fastest: float = 0.0
    home_at: int = 0
    switch_at: int | None = None
    late: float = 0.0
    early: float = 0.0

    @classmethod
    def matching(cls, settings: EpicsSettings) -> Self:
        return cls(settings.counts_per_turn, settings.unit)

    def controller(self, clock: Clock, line: TriggerLine) -> MotorRecord:
        return MotorRecord(clock, line, self)


class MotorRecord(BytesWire):
    """A motor record; it can be used from several threads. It has fields and ignores bytes.

    Attributes:
        state: the fields that do not follow from the motor; a test changes them like a person at the record's screen.
        broken: True: the IOC has lost the controller, and values of the motor are INVALID.
    """

    def __init__(self, clock: Clock, line: TriggerLine, build: EpicsBuild) -> None:
        super().__init__(clock)
        self.broken = False
        self._build, self._homed = build, False
        self._step = 360 / build.counts_per_turn
        self.motor = PulseMotor(clock, lambda: line, counts_per_turn=build.counts_per_turn, switch_at=build.switch_at)
        line.attach_angle(self.motor.angle_at)
        self.state: dict[str, float | str] = {
            ".VAL": 0.0, ".EGU": build.unit, ".MRES": self._step, ".HLM": build.high, ".LLM": build.low,
            ".VMAX": build.fastest, ".VBAS": 0.0, ".VELO": 1.0, ".ACCL": 0.2, ".DESC": "simulated axis",
            ".SPMG": 3.0, ".SET": 0.0, ".DISP": 0.0, ".LVIO": 0.0, ".STOP": 0.0, ".HOMF": 0.0, ".HOMR": 0.0,
        }  # fmt: skip
        moved: dict[str, Callable[[], float]] = {
            ".RBV": lambda: self.motor.position() * self._step,
            ".DMOV": lambda: float(not self._shows_motion()),
            ".MOVN": lambda: float(self.motor.moving()),
            ".MSTA": lambda: float(self._bits()),
        }
        self._moved = moved
        self._acts: dict[str, Callable[[float], None]] = {
            ".VAL": self._go, ".HOMF": self._search, ".HOMR": self._search, ".STOP": self._stop,
        }  # fmt: skip

    @property
    def suffixes(self) -> list[str]:
        """The names of the fields."""
        return [*self.state, *self._moved]

    def read(self, suffix: str) -> PvValue:
        """The present value of a field. Raises KeyError if the record has no such field."""
        with self._lock:
            if (moved := self._moved.get(suffix)) is not None:
                return PvValue(moved(), "", 3 if self.broken else 0)
            value, labels = self.state[suffix], CHOICES.get(suffix)
            return PvValue(value, labels[int(value)] if labels else "")

    def write(self, suffix: str, value: float | str) -> None:
        """Set a field, as a client does; a disabled record ignores it. Raises KeyError if the field cannot be set."""
        with self._lock:
            if self.state[".DISP"] and suffix != ".DISP":
                return
            if suffix == ".SPMG" and value not in (3.0, "Go"):
                self._stop(1.0)
            if (act := self._acts.get(suffix)) is not None:
                act(float(value))
            else:
                _ = self.state[suffix]
                labels = CHOICES.get(suffix, ())
                self.state[suffix] = float(labels.index(str(value))) if value in labels else value

    def _take(self, data: bytes) -> None:
        """Ignored."""

    def _go(self, place: float) -> None:
        low, high = (float(self.state[limit]) for limit in (".LLM", ".HLM"))
        beyond = high > low and not low <= place <= high
        self.state[".LVIO"] = float(beyond)
        if beyond or self.state[".SPMG"] != 3.0:
            return
        self.state[".VAL"] = place
        if self.state[".SET"]:
            self.motor.preset(round(place / self._step))
        else:
            self._start(round(place / self._step))

    def _search(self, wanted: float) -> None:
        if wanted:
            self._homed = True  # set at the end of the move; a stop removes it
            self._start(self._build.home_at)

    def _shows_motion(self) -> bool:
        now, move = self.clock.now(), self.motor.move
        return move.begin + self._build.late <= now < move.end - self._build.early

    def _stop(self, wanted: float) -> None:
        if wanted:
            self._homed = self._homed and not self.motor.moving()
            self.motor.stop(self._speed / float(self.state[".ACCL"]))

    @property
    def _speed(self) -> float:
        """steps/s."""
        return float(self.state[".VELO"]) / self._step

    def _start(self, target: int) -> None:
        if self.motor.moving():
            self.motor.halt()
        self.motor.start(target, self._speed, self._speed / float(self.state[".ACCL"]))

    def _bits(self) -> int:
        moving = self.motor.moving()
        bits = 0 if moving else DONE | (HOMED if self._homed else 0)
        if self.motor.ended is Ended.LIMIT and not moving:
            bits |= AT_LOW if math.copysign(1, self.motor.move.direction) < 0 else AT_HIGH
        return bits | (PROBLEM if self.broken else 0)


class SimulatedChannel:
    """Implements `drivers.epics.channel.ProcessVariable` on a record in this process."""

    def __init__(self, name: str, device: str, timeout: float) -> None:
        record = plugged(SCHEME + name)
        if not isinstance(record, MotorRecord):
            raise DeviceError(device, f"there is no simulated record {SCHEME}{name}", state="Nothing was asked")
        self.name, self._device = name, device
        self._record: MotorRecord | None = record

    def read(self, *suffixes: str) -> list[PvValue]:
        return [self._asked().read(suffix) for suffix in suffixes]

    def write(self, suffix: str, value: float | str) -> None:
        self._asked().write(suffix, value)

    def close(self) -> None:
        self._record = None

    def _asked(self) -> MotorRecord:
        if self._record is None:
            raise DeviceError(self._device, "the connection is closed", state="Nothing was asked")
        return self._record


OPENERS["sim"] = SimulatedChannel
