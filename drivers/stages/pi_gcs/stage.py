"""PI controller with GCS 2.0 (C-863 class) as rotation stage, with position-synchronised trigger pulses.

Positions come from an encoder and are valid only after a reference move (`start_home`). Before it, the stage does not
accept moves. Pulses come from a digital output in trigger mode 0; the controller does not count them.
"""

from __future__ import annotations

import math
from contextlib import closing
from fractions import Fraction

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import TriggerTrain
from drivers.stages.pi_gcs.axis import STOP_ALL, PiAxisStatus, PiGcsAxis
from drivers.stages.pi_gcs.line import EVENTS, MOTION, STOPPED, GcsLine, advice, meaning
from drivers.stages.pi_gcs.settings import SLOWEST, PiGcsSettings, is_spent_by, window_of
from drivers.stages.shared import POLL, LineStage, StageOutput, found_at_opening, refuse_another, until_standing


class PiGcsStage(LineStage):
    """PI controller with GCS 2.0 as a rotation stage; see the module.

    Opening switches the servo on and the trigger line off. Closing does not change them. It restores velocity and
    accelerations, except during a move, which it does not stop. `abort` stops all axes of the controller. A move that
    would emit a train a second time, or turn back inside it, disarms the train.

    Args:
        url: pyserial URL.
    """

    Settings = PiGcsSettings

    def __init__(self, url: str, settings: PiGcsSettings, clock: Clock, name: str = "stage") -> None:
        super().__init__(url, settings, clock, name)
        self._settings = settings
        self._per_radian = Fraction(settings.counts_per_turn) / Fraction(2 * math.pi)
        self._train: TriggerTrain | None = None
        self._reported = 0  # the code of the error register that an error has already reported
        self._line = GcsLine(url, settings.axis, settings, clock, name)
        self._axis = PiGcsAxis(self._line, settings, name)
        self._found = self._axis.found
        with self._closed_on_failure():
            self._identity = self._axis.open(Fraction(settings.acceleration) * self._per_radian)
            self._serial = self._identity.split(",")[2].strip() if self._identity.count(",") >= 2 else ""
            refuse_another(name, settings.serial, self._serial)
            self._travel.refuse_narrower(*self._axis.own_limits(), advice="widen the travel range in the controller")

    @staticmethod
    def halt(url: str, settings: PiGcsSettings, clock: Clock) -> None:
        with closing(GcsLine(url, settings.axis, settings, clock, "stage")) as line:
            line.stop(STOP_ALL)

    def _counts(self) -> int:
        return self._axis.counts()

    def start_move(self, angle: float, speed: float) -> None:
        target = self._travel.target(angle)
        if not SLOWEST <= math.degrees(speed) <= math.degrees(self.limits.max_speed) * (1 + 1e-12):
            raise self._travel.no_such_speed(speed, f"{SLOWEST:g} deg/s or more")
        with self._stops.none_while("the move"):
            self._axis.standing("a move")
            self._refuse_unreported()
            if self._train is not None and is_spent_by(self._train, self._axis.counts(), target):
                self.disarm()
            # Clear the earlier move, because it is not the reason if this one fails.
            self._target, self._searching = None, False
            self._axis.start(target, Fraction(speed) * self._per_radian)
            self._reported = 0
            self._target = target

    def start_home(self) -> None:
        """Begin the reference move; soft limits do not apply on the way. It disarms a train."""
        with self._stops.none_while("the reference move"):
            self._axis.standing("a reference move")
            self._train, self._target, self._searching = None, None, False
            self._axis.search_reference(self._settings.reference.command)
            self._searching = True

    def moving(self) -> bool:
        return self._axis.searching() if self._searching else self._axis.moving()

    def wait(self, timeout: float) -> float:
        target, homing = self._target, self._searching
        if until_standing(self._clock, self.moving, bool, timeout):
            raise self._travel.still_moving(timeout, self._axis.counts(), self._aim, self._axis.last_move)
        if target is not None:
            self._until_settled(target)
        status = self._axis.status()
        if homing and not status.homed:
            error = self._stopped_short("the reference move stopped short", status, "the reference found")
            self._searching = False
            raise error
        if homing:
            self._searching = False
        elif target is not None and (self._away(status.counts) or not status.servo):
            wanted = f"{self._travel.degrees(target)}, {target} counts"
            raise self._stopped_short(f"it stopped short of {self._travel.degrees(target)}", status, wanted)
        elif target is not None and self._line.fault in MOTION:
            raise self._stopped_short(f"a fault at {self._travel.degrees(target)}", status, "no error of the move")
        return self.to_angle(status.counts)

    def arm(self, train: TriggerTrain) -> None:
        self._travel.refuse_train(train)
        try:
            window = window_of(train, self._settings.first_pulse)
        except ValueError as problem:
            raise self._travel.cannot_emit(train, f": {problem}") from problem
        self._axis.standing("arming")
        self._travel.refuse_late_arming(train, self._axis.counts(), window.start)
        self._train = None
        self._axis.arm(window, self._settings.active_high)
        self._train = train

    def disarm(self) -> None:
        """Disarm the trigger output in any state, also while the stage moves."""
        self._axis.disarm()
        self._train = None

    def describe(self) -> dict[str, str | int | float]:
        return {
            "model": "PI GCS 2.0",
            "identity": self._identity,
            "port": self._url,
            "axis": self._settings.axis,
            "trigger_output": f"digital output {self._settings.trigger_line}",
            "trigger_polarity": "active high" if self._settings.active_high else "active low",
            "first_pulse": self._settings.first_pulse.value,
            "pulse_width_s": "fixed by the firmware",
            **({"serial": self._serial} if self._serial else {}),
            **found_at_opening(meaning(self._axis.error_at_opening), self._found.notice),
            **self._travel.described(),
        }

    def digital_output(self, number: int) -> StageOutput:
        if number == self._settings.trigger_line:
            raise DeviceRefused(self.name, f"output {number} gives the trigger pulses", state="Nothing was sent")
        return StageOutput(
            f"{self.name} output {number}",
            lambda high: self._line.set(f"DIO {number} {int(high)}"),
            lambda: None,  # `DIO?` reads the inputs [from memory: of GCS controllers in general]
        )

    def _release(self) -> None:
        with closing(self._line):
            self._axis.restore()

    def _refuse_unreported(self) -> None:
        """Raise DeviceError, once, if something disturbed the axis since its last move."""
        code = self._line.fault
        if code not in MOTION or code == self._reported:
            return
        self._reported = code
        place = self._travel.degrees(self._axis.counts())
        raise DeviceError(
            self.name,
            f"the axis was disturbed since its last move: {meaning(code)}",
            reply=str(code),
            expected="an axis at rest",
            advice=f"{advice(code)}. Frames taken since that move may have another angle than stated",
            state=f"Nothing has moved because of this request; the stage is at {place}",
        )

    def _send_stop(self, hard: bool) -> str:
        return self._axis.stop_all() if hard else self._axis.brake()

    def _until_settled(self, target: int) -> None:
        """Wait for the servo to reach the target, if the stage is near it."""
        deadline = self._clock.now() + self._settings.settle
        while self._clock.now() < deadline and not self._axis.on_target() and not self._away(self._axis.counts()):
            self._clock.sleep(POLL)

    def _away(self, counts: int) -> bool:
        return self._target is not None and abs(counts - self._target) > self._settings.tolerance

    def _fault(self, status: PiAxisStatus) -> str:
        """Text on why the last move ended early, or on a present fault; "" if there is none."""
        code, words = self._line.fault, []
        early = self._away(status.counts) or (self._searching and not status.homed)
        if code and code != STOPPED:
            words.append(meaning(code))
        elif early and (code == STOPPED or self._stops.came_since):
            words.append(meaning(STOPPED))
        elif early:
            words.append(self._axis.limit_switch() or "no reason given")
        if not status.servo:
            words.append("the servo is off")
        return ", ".join(words)

    def _stopped_short(self, problem: str, status: PiAxisStatus, expected: str) -> DeviceError:
        code, why = self._line.fault, self._fault(status) or "no reason given"
        self._reported = code
        return DeviceError(
            self.name,
            f"{problem} ({why})",
            request=self._axis.last_move,
            reply=status.raw,
            expected=expected,
            advice=advice(code)
            if code in EVENTS
            else "Find what stopped the stage (limit switch, person) before you move it again",
            state=f"It is at {self._travel.degrees(status.counts)}, {status.counts} counts"
            + ("" if status.homed else ", but it has not found its reference, so its true angle is unknown"),
        )
