"""Zaber rotary stage with triggers (ASCII protocol, firmware 7.06 or later): pulses on a digital output by distance.

Positions are commanded microsteps unless `measured`. What is known of the firmware from memory only is a setting:
`speed_unit` here, the rest in `drivers.stages.zaber_train.PulseSettings`.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from pathlib import Path

from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.protocols import StageLimits, StageStatus, TriggerTrain
from drivers.stages.zaber_axis import SPEED_UNIT, AxisStatus, ZaberAxis, native_limits
from drivers.stages.zaber_packet import meaning_of
from drivers.stages.zaber_pulses import ZaberOutput, ZaberPulses
from drivers.stages.zaber_train import PulseSettings, refusal

POLL = 0.02
"""s between looks at a moving stage."""
STANDING_IN_PLACE = 10.0
"""s beyond twice the time of a short move after which it has failed."""
STOP_MARGIN = 2.0
"""s beyond the longest deceleration after which a stop has failed."""


class ZaberStage:
    """Implements `drivers.protocols.RotationStage`. Closing it leaves a move under way to end by itself, takes an armed
    train away and leaves speed, acceleration and checksums as they were found.

    `stop` returns when the stage stands, `abort` at once; a `wait` for a move that was stopped, by whomever, raises. A
    move against a train under way ends the train: the controller counts distance both ways. With `pulses.chained` false
    `arm` itself turns the stage to one step before the first pulse and waits; it then speeds up over the first pulses.

    Args:
        url: what pyserial opens; a controller's LAN port is "socket://host:55550".
        device, axis: address in the chain, axis of the device.
        output: digital output of the pulses, from 1.
        counts_per_turn: microsteps for 2π; must be the device's own limit.cycle.dist.
        timeout: s for a reply.
        max_speed, acceleration: rad/s, rad/s²; the acceleration becomes one that the controller has, see `limits`.
        low, high: soft limits in radians.
        pulse_width: s, whole milliseconds; None is 1 ms, or half an interval where `toggle`.
        active_high: the output rests low.
        toggle: fires toggle the output (for firmware without `schedule`); intervals must then be even.
        speed_unit: see `SPEED_UNIT` [memory: the vendor's long-standing convention].
        pulses: what else of the triggers can be chosen; output, width and polarity are those given here.
        transcript: file to which every byte on the wire is appended; None keeps none.

    Raises:
        DeviceRefused: the settings do not fit the controller, or it is moving. DeviceError, DeviceTimeout: no contact.
    """

    def __init__(
        self,
        url: str,
        *,
        device: int = 1,
        axis: int = 1,
        output: int = 1,
        counts_per_turn: int,
        clock: Clock,
        timeout: float = 1.0,
        max_speed: float,
        acceleration: float,
        low: float,
        high: float,
        name: str = "stage",
        baudrate: int = 115_200,
        pulse_width: float | None = None,
        active_high: bool = True,
        toggle: bool = False,
        speed_unit: float = SPEED_UNIT,
        pulses: PulseSettings | None = None,
        transcript: Path | None = None,
    ) -> None:
        self.name = name
        self._clock, self._url, self._where, self._counts_per_turn = clock, url, (device, axis), counts_per_turn
        self._speed_unit = speed_unit
        try:
            if not (1 <= device <= 99 and 1 <= axis <= 9):
                raise ValueError(f"device {device}, axis {axis} do not exist; they are 1 to 99 and 1 to 9")
            if toggle and pulse_width is not None:
                raise ValueError("a toggled output has no pulse width of its own; leave pulse_width or toggle out")
            width = None if toggle else 1e-3 if pulse_width is None else pulse_width
            chosen = replace(pulses or PulseSettings(), output=output, width=width, active_high=active_high)
            speed, self._steepest = native_limits(counts_per_turn, max_speed, acceleration, speed_unit)
        except ValueError as problem:
            raise DeviceRefused(name, str(problem), state="Nothing was sent") from problem
        self._fastest = speed
        self._low, self._high = self.to_counts(low), self.to_counts(high)
        self._target: int | None = None
        self._homing = False
        self._closed = False
        self._axis = ZaberAxis(
            url,
            device=device,
            axis=axis,
            name=name,
            clock=clock,
            timeout=timeout,
            baudrate=baudrate,
            transcript=transcript,
        )
        self._pulses = ZaberPulses(self._axis, chosen, name)
        try:
            self._identity = self._axis.open()
            self._check_turn_and_travel()
            self._axis.set("accel", self._steepest)
            if self._identity.has_triggers:
                self._pulses.disarm()  # of whoever was here before and died
        except DeviceError:
            self.close()
            raise
        actual = self._steepest * 1e4 / speed_unit * 2 * math.pi / counts_per_turn
        self._limits = StageLimits(counts_per_turn, max_speed, actual, low, high, self._identity.has_triggers)

    @property
    def limits(self) -> StageLimits:
        return self._limits

    def to_counts(self, angle: float) -> int:
        return round(angle * self._counts_per_turn / (2 * math.pi))

    def to_angle(self, counts: int) -> float:
        return counts * 2 * math.pi / self._counts_per_turn

    def position(self) -> float:
        return self.to_angle(self._axis.status().counts)

    def status(self) -> StageStatus:
        status = self._axis.status()
        fault = meaning_of(status.flags)
        return StageStatus(status.counts, status.moving, status.referenced, "" if fault is None else fault.text)

    def start_move(self, angle: float, speed: float) -> None:
        if not math.isfinite(angle) or not self._low <= self.to_counts(angle) <= self._high:
            raise DeviceRefused(
                self.name,
                f"a move to {math.degrees(angle):g} deg is beyond the soft limits",
                expected=self._range(),
                state="Nothing has moved",
            )
        native = round(speed * self._counts_per_turn / (2 * math.pi) * self._speed_unit) if math.isfinite(speed) else 0
        if not 1 <= native <= self._fastest:
            raise DeviceRefused(
                self.name,
                f"a speed of {math.degrees(speed):g} deg/s (native {native}) is not possible",
                expected=f"native 1 to {self._fastest}, at most {math.degrees(self._limits.max_speed):g} deg/s",
                state="Nothing has moved",
            )
        status = self._axis.standing("a move")
        if not status.referenced:
            raise DeviceRefused(
                self.name,
                "a move is not possible: its position is not referenced",
                reply=status.raw,
                advice="Search the reference (home) first",
                state="Nothing has moved",
            )
        self._start(status, self.to_counts(angle), native)

    def start_home(self) -> None:
        """Begin the search at the speed and acceleration that the controller has for it."""
        status = self._axis.standing("a search for the reference")
        self.disarm()
        if status.flags:
            self._axis.forget_flags()
        self._axis.home()
        self._target, self._homing = None, True

    def moving(self) -> bool:
        return self._axis.status().moving

    def wait(self, timeout: float) -> float:
        status = self._until_standing(timeout)
        aim = "its reference" if self._homing else "" if self._target is None else self._deg(self._target)
        if status.moving:
            raise DeviceTimeout(
                self.name,
                f"still moving after {timeout:g} s",
                request=self._axis.last_move,
                reply=status.raw,
                expected=f"to stand at {aim}" if aim else "",
                advice="Allow more time, or stop it",
                state=f"It was left moving and is at {self._deg(status.counts)}",
            )
        fault = meaning_of(status.flags)
        if self._homing:
            arrived = status.referenced and "NI" not in status.flags
        else:
            arrived = self._target is None or status.counts == self._target
        if not arrived or (aim and status.faulty):
            raise DeviceError(
                self.name,
                f"a fault at {aim}" if arrived else f"it stopped short of {aim}",
                request=self._axis.last_move,
                reply=status.raw,
                expected=f"to stand at {aim} without a fault",
                advice="Find what stopped it before moving on" if fault is None else fault.advice,
                state=f"It stands at {self._deg(status.counts)}, {status.counts} counts: "
                + ("no reason given" if fault is None else fault.text),
            )
        self._homing = False
        return self.to_angle(status.counts)

    def arm(self, train: TriggerTrain) -> None:
        full_speed = self._limits.max_speed * self._counts_per_turn / (2 * math.pi)
        within = all(self._low <= at <= self._high for at in (train.start, train.end))
        if problem := refusal(self._pulses.settings, train, full_speed) or ("" if within else "all within the limits"):
            raise DeviceRefused(
                self.name,
                f"{train.n} pulses every {train.interval} counts from {self._deg(train.start)} cannot be emitted",
                expected=f"{problem}; the limits are {self._range()}",
                state="Nothing has moved and nothing was sent",
            )
        if not self._limits.trigger_output:
            raise DeviceRefused(
                self.name,
                f"its firmware {self._identity.firmware} has no triggers",
                expected="7.06 or later",
                advice="Update the firmware with the vendor's software",
                state="Nothing has moved and this train is not armed",
            )
        counts = self._axis.standing("arming").counts
        if train.interval * (train.start - counts) <= 0:
            raise DeviceRefused(
                self.name,
                f"it stands at {self._deg(counts)}, at or past the first pulse at {self._deg(train.start)}",
                advice="Move to before the first pulse, then arm",
                state="Nothing has moved and this train is not armed",
            )
        self._pulses.arm(train, counts, self._stand_at)

    def disarm(self) -> None:
        """Legal in every state. The output is put at rest."""
        self._pulses.disarm()

    def remaining_pulses(self) -> int:
        """By the fires that the controller's triggers still count."""
        return self._pulses.remaining()

    def stop(self) -> None:
        packet = self._axis.stop("stop")
        longest = self._limits.max_speed / self._limits.acceleration + STOP_MARGIN
        status = self._until_standing(longest)
        if status.moving:
            raise DeviceTimeout(
                self.name,
                f"still moving {longest:.1f} s after the stop command",
                request=packet,
                reply=status.raw,
                advice="Abort, or use the emergency stop",
                state=f"It is moving, at {self._deg(status.counts)}",
            )

    def abort(self) -> None:
        self._axis.stop("estop")

    def describe(self) -> dict[str, str | int | float]:
        pulses, (device, axis) = self._pulses.settings, self._where
        return {
            "model": f"Zaber device {self._identity.number}",
            "serial": self._identity.serial,
            "firmware": self._identity.firmware,
            "port": self._url,
            "device": device,
            "axis": axis,
            "trigger_output": f"digital output {pulses.output}",
            "trigger_position": "encoder" if pulses.measured else "commanded",
            "pulse_width_s": "half an interval" if pulses.width is None else pulses.milliseconds / 1000,
            "pulse_active_high": int(pulses.active_high),
            "counts_per_turn": self._counts_per_turn,
            "max_speed_rad_s": self._limits.max_speed,
            "acceleration_rad_s2": self._limits.acceleration,
            "low_rad": self._limits.low,
            "high_rad": self._limits.high,
        }

    def digital_output(self, number: int) -> ZaberOutput:
        """Another output of the device, such as one that opens a shutter.

        Raises:
            DeviceRefused: it is the one of the trigger pulses.
        """
        if number == self._pulses.settings.output:
            raise DeviceRefused(self.name, f"output {number} gives the trigger pulses", state="Nothing was sent")
        return ZaberOutput(self._axis, number, f"{self.name} output {number}")

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            with contextlib.suppress(DeviceError):  # closing a dead line is no news to whoever closes
                self.disarm()
            with contextlib.suppress(DeviceError):
                self._axis.close()

    def _start(self, status: AxisStatus, target: int, native: int) -> None:
        """Begin a move from standing."""
        self._pulses.before_move(status.counts, target)
        if status.flags:
            self._axis.forget_flags()
        self._axis.set("maxspeed", native)
        self._axis.move(target)
        self._target, self._homing = target, False

    def _stand_at(self, counts: int) -> None:
        """Turn there and wait."""
        way = abs(self.to_angle(counts - self._axis.standing("arming").counts))
        self.start_move(self.to_angle(counts), self._limits.max_speed)
        self.wait(2 * way / self._limits.max_speed + STANDING_IN_PLACE)

    def _check_turn_and_travel(self) -> None:
        own = self._axis.cycle()
        if own is None or float(own) != self._counts_per_turn:
            raise DeviceRefused(
                self.name,
                "it has no limit.cycle.dist, so it does not rotate" if own is None else f"a turn has {own} microsteps",
                expected=f"{self._counts_per_turn} a turn, as configured",
                advice="Correct counts_per_turn, or check device and axis",
                state="Nothing has moved",
            )
        low, high = self._axis.travel()
        if self._low < low or self._high > high:
            raise DeviceRefused(
                self.name,
                f"the controller itself is limited to {self._deg(low)} to {self._deg(high)}",
                expected=f"room for the configured {math.degrees(self.to_angle(self._low)):g} to "
                f"{math.degrees(self.to_angle(self._high)):g} deg",
                advice="Narrow low and high in the configuration, or widen the controller's limits",
                state="Nothing has moved",
            )

    def _until_standing(self, timeout: float) -> AxisStatus:
        """The status once the stage stands, or when the time is over."""
        deadline = self._clock.now() + timeout
        while (status := self._axis.status()).moving and (left := deadline - self._clock.now()) > 0:
            self._clock.sleep(min(POLL, left))
        return status

    def _range(self) -> str:
        return f"{math.degrees(self._limits.low):g} to {math.degrees(self._limits.high):g} deg"

    def _deg(self, counts: int) -> str:
        return f"{math.degrees(self.to_angle(counts)):.4f} deg"
