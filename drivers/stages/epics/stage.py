"""EPICS motor record as a stage, over PVAccess or Channel Access (Mooney and Sluiter, motor record reference, R7).

The record has no trigger output, so only step scans are possible. A move has ended when DMOV is 1; RBV then shows
whether the motor arrived. A record should set DMOV to 0 before the write of VAL is answered. Some records do so later,
and some set 1 while the motor still turns. So a motor that is not at its target counts as stopped only if its position
has not changed for `STILL`.
"""

from __future__ import annotations

import contextlib
import math
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar, NoReturn

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import DigitalOutput, StageLimits, TriggerTrain
from drivers.epics.channel import PvValue, open_channel, refuse_invalid
from drivers.stages.settings import StageFigures
from drivers.stages.shared import FoundSettings, LineStage, found_at_opening, until_standing, while_it_moves
from recon.base.setting import setting


class Search(StrEnum):
    """The direction in which the record searches its reference."""

    NONE = "none"
    FORWARD = "forward"
    REVERSE = "reverse"

    @property
    def field(self) -> str:
        """Field of the record that begins the search."""
        return {"none": "", "forward": ".HOMF", "reverse": ".HOMR"}[self]


@dataclass(frozen=True, kw_only=True)
class EpicsSettings(StageFigures):
    """EPICS motor record at pva://NAME or ca://NAME. It gives no trigger pulses: step scans only.

    `unit` is the record's EGU. If it is not deg, as for a linear sample mover, all keys with deg in their names use
    this unit.
    """

    pulse_output: ClassVar[None] = None
    """A motor record has no output that can be set."""
    pulse_width: ClassVar[None] = None
    active_high: ClassVar[bool] = True
    """There is no cable; only checks of trigger pulses need one."""
    unit: str = setting(
        "deg",
        "Unit of the record (EGU). For a linear axis the unit is mm, and every key with deg in its name is then in mm.",
    )
    search: Search = setting(
        Search.NONE, "How `beamline home` searches the reference: none, forward (HOMF) or reverse (HOMR)."
    )
    tolerance: int = setting(
        10, "Largest distance from the target, in counts, at which a move counts as finished.", unit="counts", ge=0
    )
    timeout: float = setting(2.0, "Longest time in s that the driver waits for an answer of the IOC.", unit="s", gt=0)

    def limits(self) -> StageLimits:
        """See `StageSettings`."""
        return StageLimits(
            self.counts_per_turn,
            self.max_speed,
            self.acceleration,
            self.low,
            self.high,
            False,
            tolerance=self.tolerance,
        )


HOMED = 0x4000 | 0x0080
"""Bits of MSTA: the reference was found, or the motor is at the reference."""
FAULTS = {  # bit of MSTA: its meaning, and advice
    0x0200: (
        "the IOC lost its controller, or the controller reports a fault",
        "Check the controller, and read the messages in the IOC's shell",
    ),
    0x1000: ("the IOC has no contact with its controller", "Check the controller's power and its cable to the IOC"),
    0x0040: ("it slipped or stalled", "Find what blocks the stage before you move it again"),
    0x0004: ("it is at its upper limit switch", "Move the stage off the switch by hand or in the record's own screen"),
    0x2000: ("it is at its lower limit switch", "Move the stage off the switch by hand or in the record's own screen"),
}
# if DMOV is 1 and the motor is not at its target, it counts as stopped when RBV has not changed for this time in s
STILL = 1.0
CREEP = 10.0  # s; shortest time that such a motor gets to stop
GO, USE = "Go", "Use"
"""Labels of SPMG and SET with which a value written to VAL moves the motor."""


@dataclass(frozen=True)
class MotorStatus:
    """State of the record: position in its unit, whether the move has ended, and MSTA."""

    place: float
    done: bool
    bits: int

    @property
    def fault(self) -> tuple[str, str]:
        """Fault in MSTA, and advice; empty texts without a fault."""
        faults = [fault_of_bit for bit, fault_of_bit in FAULTS.items() if self.bits & bit]
        return (", ".join(text for text, _ in faults), faults[0][1]) if faults else ("", "")


class EpicsStage(LineStage):
    """EPICS motor record as a stage; see the module.

    Opening checks unit, step size, limits and speed of the record. VELO and ACCL are set for each move. Closing
    restores them and does not stop a move.

    Args:
        url: pva://NAME or ca://NAME of the record.
    """

    Settings = EpicsSettings

    def __init__(self, url: str, settings: EpicsSettings, clock: Clock, name: str = "stage") -> None:
        super().__init__(url, settings, clock, name)
        self._settings, self._last = settings, ""
        self._channel = open_channel(url, name, settings.timeout)
        # s; times of the last move, of the last read, and of the last change of position
        self._begun = self._looked = self._same_since = -math.inf
        self._place = math.nan
        self._found = FoundSettings()
        with self._closed_on_failure():
            self._model = self._checked()

    @staticmethod
    def halt(url: str, settings: EpicsSettings, clock: Clock) -> None:
        with closing(open_channel(url, "stage", settings.timeout)) as channel:
            channel.write(".STOP", 1)

    def start_move(self, angle: float, speed: float) -> None:
        target = self._travel.target(angle)
        if not 0 < speed <= self.limits.max_speed * (1 + 1e-12) or math.degrees(speed) < self._slowest:
            raise self._travel.no_such_speed(speed, f"{self._slowest:g} deg/s or more")
        with self._stops.none_while("the move"):
            self._standing("a move")
            self._refuse_unless_it_would_go()
            self._target, self._searching = None, False
            self._channel.write(".VELO", math.degrees(speed))
            self._channel.write(".ACCL", speed / self.limits.acceleration)
            place = target * 360 / self.limits.counts_per_turn
            self._last = f"{self._channel.name}.VAL = {place:.10g}"
            self._channel.write(".VAL", place)
            (refused,) = self._read(".LVIO")
            if refused.value:
                raise DeviceRefused(
                    self.name,
                    f"the record rejected {self._travel.degrees(target)}, which is beyond the limits of the record "
                    "(LVIO)",
                    request=self._last,
                    advice="Compare HLM and LLM of the record with low_deg and high_deg",
                    state="Nothing has moved",
                )
        self._target, self._begun = target, self._clock.now()

    def start_home(self) -> None:
        """Begin the search for the reference; soft limits do not apply on the way."""
        if self._settings.search is Search.NONE:
            raise DeviceRefused(
                self.name,
                "the configuration defines no search for the reference of this stage (search: none)",
                advice="Set devices.stage.search to forward or reverse, or home the stage in the record's own screen",
                state="Nothing has moved",
            )
        with self._stops.none_while("the search for the reference"):
            self._standing("a search for the reference")
            self._refuse_unless_it_would_go()
            self._last = f"{self._channel.name}{self._settings.search.field} = 1"
            self._channel.write(self._settings.search.field, 1)
        self._target, self._searching = None, True

    def moving(self) -> bool:
        status, now = self._status(), self._clock.now()
        recent, same = now - self._looked <= STILL, status.place == self._place
        if not (recent and same):
            self._same_since = now
        self._looked, self._place = now, status.place
        if not status.done:
            return True
        if self._target is None or self._is_at_target(status) or self._stops.came_since:
            return False
        return now - self._begun < STILL or (recent and not same)

    def wait(self, timeout: float) -> float:
        until_standing(self._clock, self.moving, bool, timeout)
        status, target = self._status(), self._target  # read again: RBV may have been read before DMOV became 1
        arrived = target is None or self._is_at_target(status)
        if status.done and not (arrived or self._stops.came_since):
            # The record reports the end of the move, but the motor is not at the target. Check whether it has stopped.
            longest = max(timeout, CREEP)
            until_standing(self._clock, lambda: self.moving() or not self._seen_to_stand, bool, longest)
            status = self._status()
            arrived = self._is_at_target(status)
        counts, aim = self._counts_of(status), self._aim
        if not status.done or not (arrived or self._stops.came_since or self._seen_to_stand):
            raise self._travel.still_moving(timeout, counts, aim, self._last, self._hindrance())
        if self._searching:
            arrived = not self._stops.came_since and bool(status.bits & HOMED)
        fault, advice = status.fault
        if not arrived and not fault:
            fault = self._hindrance()
        if not arrived or (aim and fault):
            self._failed(f"it stopped short of {aim}" if not arrived else f"a fault at {aim}", counts, fault, advice)
        self._searching = False
        return self.to_angle(counts)

    def abort(self) -> None:
        """Same as `stop`, because the record has no faster stop; the controller decelerates."""
        self.stop()

    def arm(self, train: TriggerTrain) -> None:
        raise DeviceRefused(
            self.name,
            "a motor record cannot send trigger pulses",
            advice="Use scan.mode: step, or a stage whose controller sends pulses",
            state="Nothing has moved and nothing was sent",
        )

    def disarm(self) -> None:
        """Does nothing, because the record is never armed."""

    def digital_output(self, number: int) -> DigitalOutput:
        raise DeviceRefused(
            self.name, f"a motor record has no digital output {number}", advice="Use shutter.kind: epics"
        )

    def describe(self) -> dict[str, str | int | float]:
        return {
            "model": self._model,
            "port": self._url,
            "trigger_output": "none",
            **found_at_opening(self._found.notice),
            **self._travel.described(),
        }

    def _release(self) -> None:
        with closing(self._channel):
            self._found.restore(lambda suffix, value: self._channel.write(suffix, float(value)))

    @property
    def _seen_to_stand(self) -> bool:
        """Whether the position was the same in every reading of the last `STILL` s."""
        return self._looked - self._same_since >= STILL

    def _is_at_target(self, status: MotorStatus) -> bool:
        return self._target is not None and abs(self._counts_of(status) - self._target) <= self._settings.tolerance

    def _hindrance(self) -> str:
        """The reason why a move did not reach its target, according to the record.

        "" if the record gives no reason or has no such fields.
        """
        words = []
        with contextlib.suppress(DeviceError):
            (mode,) = self._read(".SPMG")
            if mode.label != GO:
                words.append(f"SPMG is {mode}: somebody paused or stopped the motor in the record")
        with contextlib.suppress(DeviceError):
            (disabled,) = self._read(".DISP")
            if disabled.value:
                words.append("DISP is 1, so the record accepts no values")
        with contextlib.suppress(DeviceError):
            (wanted,) = self._read(".VAL")
            counts = round(float(wanted.value) * self.limits.counts_per_turn / 360)
            if self._target is not None and abs(counts - self._target) > self._settings.tolerance:
                words.append(
                    f"VAL is {wanted}: another client sent the motor somewhere else, or the record did not accept the "
                    "value"
                )
        return ", ".join(words)

    def _counts(self) -> int:
        return self._counts_of(self._status())

    def _counts_of(self, status: MotorStatus) -> int:
        return round(status.place * self.limits.counts_per_turn / 360)

    def _send_stop(self, hard: bool) -> str:
        self._channel.write(".STOP", 1)
        return f"{self._channel.name}.STOP = 1"

    def _status(self) -> MotorStatus:
        place, done, bits = self._read(".RBV", ".DMOV", ".MSTA")
        return MotorStatus(float(place.value), bool(done.value), int(bits.value))

    def _read(self, *suffixes: str) -> list[PvValue]:
        """Read values. Raises an error for a value that the IOC does not guarantee."""
        values = self._channel.read(*suffixes)
        for suffix, value in zip(suffixes, values, strict=True):
            refuse_invalid(self.name, self._channel.name + suffix, value, "It is not known whether the stage is moving")
        return values

    def _standing(self, purpose: str) -> None:
        status = self._status()
        if not status.done:
            raise while_it_moves(self.name, purpose, self._counts_of(status))

    def _refuse_unless_it_would_go(self) -> None:
        """Raise DeviceRefused if the record would accept a position without a move, because of SPMG or SET."""
        for suffix, wanted in ((".SPMG", GO), (".SET", USE)):
            (field_value,) = self._read(suffix)
            if field_value.label != wanted:
                raise DeviceRefused(
                    self.name,
                    f"{self._channel.name}{suffix} is {field_value}, so the record would not move the motor",
                    expected=wanted,
                    advice="Set this field in the record's own screen; somebody may have stopped this motor on purpose",
                    state="Nothing has moved",
                )

    def _failed(self, problem: str, counts: int, fault: str, advice: str) -> NoReturn:
        verb = "stands" if self._seen_to_stand else "is"
        raise DeviceError(
            self.name,
            problem,
            request=self._last,
            expected="to be there without a fault",
            advice=advice or "Find who or what stopped the stage before you move it again",
            state=f"It {verb} at {self._travel.degrees(counts)}, {counts} counts: {fault or 'no reason given'}",
        )

    def _checked(self) -> str:
        """Description of the record; raises DeviceRefused if it does not match the settings.

        Stores what moves change.
        """
        fields = (".EGU", ".MRES", ".HLM", ".LLM", ".VMAX", ".VBAS", ".VELO", ".ACCL", ".DESC")
        unit, step, high, low, fastest, slowest, velocity, seconds, about = self._read(*fields)
        settings, per_unit = self._settings, self.limits.counts_per_turn / 360
        greatest = math.degrees(self.limits.max_speed)
        wrong = ""
        if unit.value != settings.unit:
            wrong, advice = f"its unit (EGU) is {unit.value!r}, expected {settings.unit!r}", "Correct unit or EGU"
        elif abs(abs(float(step.value)) * per_unit - 1) > 1e-6:
            expected_step = 1 / per_unit
            wrong = f"the step of the motor record (MRES) is {step.value:g} {settings.unit}, expected {expected_step:g}"
            advice = "Set counts_per_turn to 360 / MRES"
        elif 0 < float(fastest.value) < greatest * (1 - 1e-9):
            wrong = (
                f"the maximum speed of the motor record (VMAX) is {fastest.value:g}, below the maximum speed of "
                f"{greatest:g} {settings.unit}/s in the configuration"
            )
            advice = "Set max_speed_deg_s to VMAX or less"
        if wrong:
            problem = f"the record {self._channel.name} does not fit: {wrong}"
            raise DeviceRefused(self.name, problem, advice=advice, state="Nothing has moved")
        if float(high.value) > float(low.value):  # if both are 0, the record has no soft limits
            low_counts = math.ceil(float(low.value) * per_unit - 1e-6)
            high_counts = math.floor(float(high.value) * per_unit + 1e-6)
            self._travel.refuse_narrower(low_counts, high_counts, "widen LLM and HLM of the record")
        self._standing("opening")
        self._slowest = max(float(slowest.value), 0.0)
        self._found.values = {".VELO": velocity.text, ".ACCL": seconds.text}
        return f"EPICS motor record {self._channel.name} ({about.value})"
