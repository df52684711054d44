"""Tsuji PM16C-04XD(L) as rotation stage: a serial pulse motor controller with position-synchronised trigger pulses.

Positions are commanded pulses, not an encoder's. Pulses come from TP0. The controller's own soft limits are respected
and never changed.
"""

from __future__ import annotations

import contextlib
import math
from pathlib import Path

from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.protocols import StageLimits, StageStatus, TriggerTrain
from drivers.stages.pm16c_channel import MAX_SPEED, RATES, ChannelStatus, PM16CChannel, steepest_code
from drivers.stages.pm16c_home import HomeSearch
from drivers.stages.pm16c_train import MODES, PulseWidths

POLL = 0.02
"""s between looks at a moving stage."""
STOP_MARGIN = 2.0
"""s beyond the longest deceleration after which a stop has failed."""


def limits_of(counts_per_turn: int, max_speed: float, acceleration: float, low: float, high: float) -> StageLimits:
    """What the controller makes of the figures configured for a stage (rad/s, rad/s², rad): its acceleration is the
    steepest one that it has and that is not above `acceleration`.

    Raises:
        ValueError: a speed that it does not have, or even its gentlest acceleration is above.
    """
    radians = 2 * math.pi / counts_per_turn
    fastest = round(max_speed / radians)
    if not 1 <= fastest <= MAX_SPEED:
        raise ValueError(
            f"{math.degrees(max_speed):g} deg/s are {fastest} pulses/s, the controller gives 1 to {MAX_SPEED}"
        )
    acceleration = 1e6 / RATES[steepest_code(acceleration / radians)] * radians
    return StageLimits(counts_per_turn, max_speed, acceleration, low, high, trigger_output=True)


class PM16CStage:
    """Implements `drivers.protocols.RotationStage`. Closing it leaves a move under way to end by itself.

    `stop` returns when the stage stands, `abort` at once; a `wait` for a move that was stopped, by whomever, raises: no
    thread takes it for arrived. Arming and disarming need a standing stage.

    Args:
        url: what pyserial opens; the controller's LAN port is "socket://host:7777".
        channel: motor channel 0..15.
        counts_per_turn: pulses for 2π.
        timeout: s for a reply.
        max_speed, acceleration: rad/s, rad/s²; the acceleration becomes one that the controller has, see `limits`.
        low, high: soft limits in radians.
        baudrate: as set on the controller's panel.
        pulse_width: s, one of the four that the output has; None takes for each train the widest that fits.
        active_high: must be True; the output has no other polarity.
        home: angle of the home switch in radians; None where the stage has none: then a search is refused.
        home_speed: rad/s for the search; None is a tenth of `max_speed`.
        transcript: file to which every byte on the wire is appended; None keeps none.

    Raises:
        DeviceRefused: the settings do not fit the controller, or it is moving. DeviceError, DeviceTimeout: no contact.
    """

    def __init__(
        self,
        url: str,
        *,
        channel: int = 0,
        counts_per_turn: int,
        clock: Clock,
        timeout: float = 1.0,
        max_speed: float,
        acceleration: float,
        low: float,
        high: float,
        name: str = "stage",
        baudrate: int = 9600,
        pulse_width: float | None = None,
        active_high: bool = True,
        home: float | None = None,
        home_speed: float | None = None,
        transcript: Path | None = None,
    ) -> None:
        self.name = name
        self._clock, self._url, self._number, self._counts_per_turn = clock, url, channel, counts_per_turn
        if not 0 <= channel <= 15:
            raise DeviceRefused(name, f"there is no channel {channel}", expected="0 to 15", state="Nothing was sent")
        if not active_high:
            raise DeviceRefused(
                name, "its trigger output cannot be inverted", expected="active_high", state="Nothing was sent"
            )
        try:
            self._limits = limits_of(counts_per_turn, max_speed, acceleration, low, high)
            self._widths = PulseWidths(pulse_width)
            self._home = self._home_count(home)
        except ValueError as problem:
            raise DeviceRefused(name, str(problem), state="Nothing was sent") from problem
        self._low, self._high = self.to_counts(low), self.to_counts(high)
        self._fastest = round(max_speed * counts_per_turn / (2 * math.pi))
        self._home_pps = self._pps(self._limits.max_speed / 10 if home_speed is None else home_speed)
        self._target: int | None = None
        self._search: HomeSearch | None = None
        self._closed = False
        self._channel = PM16CChannel(
            url, channel=channel, name=name, clock=clock, timeout=timeout, baudrate=baudrate, transcript=transcript
        )
        try:
            self._version = self._channel.open(
                steepest_code(self._limits.acceleration * counts_per_turn / (2 * math.pi))
            )
            self._check_own_limits()
        except DeviceError:
            self.close()
            raise

    @property
    def limits(self) -> StageLimits:
        return self._limits

    def to_counts(self, angle: float) -> int:
        return round(angle * self._counts_per_turn / (2 * math.pi))

    def to_angle(self, counts: int) -> float:
        return counts * 2 * math.pi / self._counts_per_turn

    def position(self) -> float:
        return self.to_angle(self._channel.counts())

    def start_move(self, angle: float, speed: float) -> None:
        if not math.isfinite(angle) or not self._low <= self.to_counts(angle) <= self._high:
            raise DeviceRefused(
                self.name,
                f"a move to {math.degrees(angle):g} deg is beyond the soft limits",
                expected=self._range(),
                state="Nothing has moved",
            )
        pps, target = self._pps(speed), self.to_counts(angle)
        self._channel.start(target, pps)
        self._target, self._search = target, None

    def start_home(self) -> None:
        """As `drivers.protocols.Motion` has it; `wait` takes the later steps, and a train that was armed is no more."""
        if self._home is None:
            raise DeviceRefused(
                self.name,
                "it has no home switch",
                advice="Where there is one, give its angle as `home` in the configuration",
                state="Nothing has moved",
            )
        search = HomeSearch(self._channel, self.name, self._home)
        search.begin(self._home_pps)
        self._target, self._search = self._home, search

    def status(self) -> StageStatus:
        """As `drivers.protocols.Motion` has it; `homed` is None where the stage has no home switch."""
        status = self._channel.status()
        homed = None if self._home is None else self._channel.home() is not None
        return StageStatus(status.counts, status.moving, homed, status.ending)

    def moving(self) -> bool:
        return self._channel.status().moving

    def wait(self, timeout: float) -> float:
        target, search = self._target, self._search
        deadline = self._clock.now() + timeout
        status = self._until_standing(timeout)
        while search is not None and not status.moving:
            if not search.go_on(status):
                self._search = search = None
            status = self._until_standing(deadline - self._clock.now())
        if status.moving:
            raise DeviceTimeout(
                self.name,
                f"still moving after {timeout:g} s",
                request=self._channel.last_move,
                reply=status.raw,
                expected="" if target is None else f"to stand at {self._deg(target)}",
                advice="Allow more time, or stop it",
                state=f"It was left moving and is at {self._deg(status.counts)}",
            )
        if target is not None and status.counts != target:
            raise DeviceError(
                self.name,
                f"it stopped short of {self._deg(target)} ({status.ending or 'no reason given'})",
                request=self._channel.last_move,
                reply=status.raw,
                expected=f"{self._deg(target)}, {target} counts",
                advice="Find what stopped it (limit switch, interlock, stop button) before moving on",
                state=f"It stands at {self._deg(status.counts)}, {status.counts} counts",
            )
        return self.to_angle(status.counts)

    def arm(self, train: TriggerTrain) -> None:
        width = self._widths.widest_for(train, self._fastest)
        within = all(self._low <= at <= self._high for at in (train.start, train.end))
        if train.n < 1 or train.interval == 0 or width is None or not within:
            raise DeviceRefused(
                self.name,
                f"{train.n} pulses every {train.interval} counts from {self._deg(train.start)} cannot be emitted",
                expected=f"one or more, not closer than {2 * self._widths.narrowest:g} s at full speed, all within "
                + self._range(),
                state="Nothing has moved and nothing was sent",
            )
        sign, counts = (1 if train.interval > 0 else -1), self._channel.standing("arming").counts
        if sign * (train.start - counts) <= 0:
            raise DeviceRefused(
                self.name,
                f"it stands at {self._deg(counts)}, at or past the first pulse at {self._deg(train.start)}",
                advice="Move to before the first pulse, then arm",
                state="Nothing has moved and this train is not armed",
            )
        # Half an interval of room behind the last pulse: whether the end point itself fires then does not matter.
        interval = max(abs(train.interval), 2) if train.n == 1 else abs(train.interval)
        self._channel.arm(MODES[width], train.start, train.end + sign * (interval // 2), interval)

    def disarm(self) -> None:
        self._channel.disarm()

    def remaining_pulses(self) -> None:
        """None: the controller says only whether the first pulse is still to come."""

    def stop(self) -> None:
        self._cancel_search()
        command = self._channel.slow_stop()
        longest = self._limits.max_speed / self._limits.acceleration + STOP_MARGIN
        status = self._until_standing(longest)
        if status.moving:
            raise DeviceTimeout(
                self.name,
                f"still moving {longest:.1f} s after the stop command",
                request=command,
                reply=status.raw,
                advice="Abort, or use the emergency stop",
                state=f"It is moving, at {self._deg(status.counts)}",
            )

    def abort(self) -> None:
        self._cancel_search()
        self._channel.emergency_stop()

    def describe(self) -> dict[str, str | int | float]:
        return {
            "model": "Tsuji PM16C-04XD(L)",
            "firmware": self._version,
            "port": self._url,
            "channel": self._number,
            "trigger_output": "TP0",
            "pulse_width_s": self._widths.chosen or "the widest that fits",
            "trigger_polarity": "active high",
            "counts_per_turn": self._counts_per_turn,
            "max_speed_rad_s": self._limits.max_speed,
            "acceleration_rad_s2": self._limits.acceleration,
            "low_rad": self._limits.low,
            "high_rad": self._limits.high,
        }

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            with contextlib.suppress(DeviceError):  # closing a dead line is no news to whoever closes
                self._channel.close()

    def _cancel_search(self) -> None:
        if (search := self._search) is not None:
            search.cancel()

    def _home_count(self, home: float | None) -> int | None:
        if home is not None and not math.isfinite(home):
            raise ValueError(f"the home switch cannot be at {home} rad")
        return None if home is None else self.to_counts(home)

    def _pps(self, speed: float) -> int:
        """Pulses/s for rad/s."""
        pps = round(speed * self._counts_per_turn / (2 * math.pi)) if math.isfinite(speed) else 0
        if not 1 <= pps <= self._fastest:
            raise DeviceRefused(
                self.name,
                f"a speed of {math.degrees(speed):g} deg/s ({pps} pulses/s) is not possible",
                expected=f"1 to {self._fastest} pulses/s, at most {math.degrees(self._limits.max_speed):g} deg/s",
                state="Nothing has moved",
            )
        return pps

    def _check_own_limits(self) -> None:
        own = self._channel.own_limits()
        if own is not None and (self._low < own[0] or self._high > own[1]):
            raise DeviceRefused(
                self.name,
                f"the controller itself is limited to {self._deg(own[0])} to {self._deg(own[1])}",
                expected=f"room for the configured {self._range()}",
                advice="Narrow low and high in the configuration, or widen the limits on the controller's panel",
                state="Nothing has moved",
            )

    def _until_standing(self, timeout: float) -> ChannelStatus:
        """The status once the stage stands, or when the time is over."""
        deadline = self._clock.now() + timeout
        while (status := self._channel.status()).moving and (left := deadline - self._clock.now()) > 0:
            self._clock.sleep(min(POLL, left))
        return status

    def _range(self) -> str:
        return f"{math.degrees(self._limits.low):g} to {math.degrees(self._limits.high):g} deg"

    def _deg(self, counts: int) -> str:
        return f"{math.degrees(self.to_angle(counts)):.4f} deg"
