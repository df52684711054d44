"""Tsuji PM16C-04XD(L) as rotation stage: a serial pulse motor controller with position-synchronised trigger pulses.

Positions are commanded pulses, not an encoder's. Pulses come from TP0. The controller's own soft limits are respected
and never changed.
"""

from __future__ import annotations

import contextlib
import math
from pathlib import Path

from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceRefused
from drivers.protocols import StageLimits, StageStatus, TriggerTrain
from drivers.stages.pm16c.channel import MAX_COUNT, ChannelStatus, PM16CChannel
from drivers.stages.pm16c.home import HomeSearch
from drivers.stages.pm16c.limits import limits_of
from drivers.stages.pm16c.rates import steepest_code
from drivers.stages.pm16c.train import MODES, FirstPulse, PulseWidths, points_of
from drivers.stages.standing import longest_stop, until_standing
from drivers.stages.stops import Stops
from drivers.stages.travel import Travel


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
        first_pulse: where the firmware puts the first pulse; that it is the start point is from memory.
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
        first_pulse: FirstPulse | str = FirstPulse.AT_START,
        home: float | None = None,
        home_speed: float | None = None,
        transcript: Path | None = None,
    ) -> None:
        self.name = name
        self._clock, self._url, self._number = clock, url, channel
        if not 0 <= channel <= 15:
            raise DeviceRefused(name, f"there is no channel {channel}", expected="0 to 15", state="Nothing was sent")
        if not active_high:
            raise DeviceRefused(
                name, "its trigger output cannot be inverted", expected="active_high", state="Nothing was sent"
            )
        try:
            self._first_pulse = FirstPulse(first_pulse)
            limits = limits_of(counts_per_turn, max_speed, acceleration, low, high, self._first_pulse, pulse_width)
            self._travel = Travel(name, limits)
            self._widths = PulseWidths(pulse_width)
            self._home = self._home_count(home)
        except ValueError as problem:
            raise DeviceRefused(name, str(problem), state="Nothing was sent") from problem
        self._fastest = round(max_speed * counts_per_turn / (2 * math.pi))
        self._home_pps = self._pps(limits.max_speed / 10 if home_speed is None else home_speed)
        self._target: int | None = None
        self._search: HomeSearch | None = None
        self._closed = False
        self._stops = Stops(name, self._send_stop)
        self._channel = PM16CChannel(
            url, channel=channel, name=name, clock=clock, timeout=timeout, baudrate=baudrate, transcript=transcript
        )
        try:
            self._version = self._channel.open(steepest_code(limits.acceleration * counts_per_turn / (2 * math.pi)))
            if (own := self._channel.own_limits()) is not None:
                self._travel.refuse_narrower(*own, advice="widen the limits on the controller's panel")
        except BaseException:
            self.close()
            raise

    @property
    def limits(self) -> StageLimits:
        return self._travel.limits

    def to_counts(self, angle: float) -> int:
        return self._travel.to_counts(angle)

    def to_angle(self, counts: int) -> float:
        return self._travel.to_angle(counts)

    def position(self) -> float:
        return self.to_angle(self._channel.counts())

    def start_move(self, angle: float, speed: float) -> None:
        target, pps = self._travel.target(angle), self._pps(speed)
        with self._stops.none_while("the move"):
            self._channel.start(target, pps)
        self._target, self._search = target, None

    def start_home(self) -> None:
        """As `drivers.protocols.Motion` has it; `wait` takes the later steps, and a train that was armed is no more."""
        if self._home is None:
            raise DeviceRefused(
                self.name,
                "it has no home switch",
                advice="Where there is one, give its angle as `home_deg` in the configuration",
                state="Nothing has moved",
            )
        search = HomeSearch(self._channel, self.name, self._home)
        with self._stops.none_while("the search"):
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
            aim = "" if target is None else self._travel.degrees(target)
            raise self._travel.still_moving(timeout, status.counts, aim, self._channel.last_move, status.raw)
        if target is not None and status.counts != target:
            raise DeviceError(
                self.name,
                f"it stopped short of {self._travel.degrees(target)} ({status.ending or 'no reason given'})",
                request=self._channel.last_move,
                reply=status.raw,
                expected=f"{self._travel.degrees(target)}, {target} counts",
                advice="Find what stopped it (limit switch, interlock, stop button) before moving on",
                state=f"It stands at {self._travel.degrees(status.counts)}, {status.counts} counts",
            )
        return self.to_angle(status.counts)

    def arm(self, train: TriggerTrain) -> None:
        self._travel.refuse_train(train)
        points, counts = points_of(train, self._first_pulse), self._channel.standing("arming").counts
        self._travel.refuse_late_arming(train, counts, points.start)
        self._channel.arm(MODES[self._widths.widest_for(train, self.limits)], points)

    def disarm(self) -> None:
        self._channel.disarm()

    def remaining_pulses(self) -> None:
        """None: the controller says only whether the first pulse is still to come."""

    def stop(self) -> None:
        self._stops.came(hard=False)
        command = self._send_stop(hard=False)
        longest = longest_stop(self.limits)
        status = self._until_standing(longest)
        if status.moving:
            raise self._travel.not_stopped(longest, status.counts, command, status.raw)

    def abort(self) -> None:
        self._stops.came(hard=True)
        self._send_stop(hard=True)

    def describe(self) -> dict[str, str | int | float]:
        return {
            "model": "Tsuji PM16C-04XD(L)",
            "firmware": self._version,
            "port": self._url,
            "channel": self._number,
            "trigger_output": "TP0",
            "pulse_width_s": self._widths.chosen or "the widest that fits",
            "trigger_polarity": "active high",
            "first_pulse": self._first_pulse.value,
            **self._travel.described(),
        }

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            with contextlib.suppress(DeviceError):  # closing a dead line is no news to whoever closes
                self._channel.close()

    def _send_stop(self, hard: bool) -> str:
        """What was sent."""
        if (search := self._search) is not None:
            search.cancel()
        return self._channel.emergency_stop() if hard else self._channel.slow_stop()

    def _home_count(self, home: float | None) -> int | None:
        if home is None:
            return None
        if not abs(home) <= self.to_angle(MAX_COUNT):
            raise ValueError(f"the home switch cannot be at {home:g} rad")
        return self.to_counts(home)

    def _pps(self, speed: float) -> int:
        """Pulses/s for rad/s."""
        possible = 0 < speed < 2 * self.limits.max_speed
        pps = round(speed * self.limits.counts_per_turn / (2 * math.pi)) if possible else 0
        if not 1 <= pps <= self._fastest:
            raise DeviceRefused(
                self.name,
                f"a speed of {math.degrees(speed):g} deg/s is not possible",
                expected=f"1 to {self._fastest} pulses/s, at most {math.degrees(self.limits.max_speed):g} deg/s",
                state="Nothing has moved",
            )
        return pps

    def _until_standing(self, timeout: float) -> ChannelStatus:
        """The status once the stage stands, or when the time is over."""
        return until_standing(self._clock, self._channel.status, lambda status: status.moving, timeout)
