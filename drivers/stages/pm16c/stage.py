"""Tsuji PM16C-04XD(L) as rotation stage: a serial pulse motor controller with position-synchronised trigger pulses.

Positions are commanded pulses; there is no encoder. Trigger pulses come from TP0. The controller's own soft limits are
respected and never changed.
"""

from __future__ import annotations

import contextlib
import math

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import DigitalOutput, TriggerTrain
from drivers.stages.pm16c.channel import ChannelStatus, PM16CChannel
from drivers.stages.pm16c.settings import MODES, PM16CSettings, points_of
from drivers.stages.shared import LineStage, found_at_opening, until_standing


class HomeSearch:
    """One search for the home switch: find it (FDHP), go back to it (GTHP), set its count (PS).

    Call `begin`, then call `go_on` each time the motor has come to rest, until it returns False. From memory, to be
    checked at an instrument: the direction of the search and the kind of the switch are set on the controller's panel;
    the speed is the selected one; a search that has found the switch may end some counts beyond it.

    Args:
        home: the count of the reference.
    """

    def __init__(self, channel: PM16CChannel, name: str, home: int) -> None:
        self._channel, self._name, self._home = channel, name, home
        self._found: int | None = None
        self._cancelled = False

    def begin(self, speed: int) -> None:
        """Start to search at `speed` pulses/s."""
        self._channel.find_home(speed)

    def cancel(self) -> None:
        """End the search, so that no further step follows. Call this before the stop is sent, from any thread."""
        self._cancelled = True

    def go_on(self, status: ChannelStatus) -> bool:
        """Make the next step after the motor has come to rest; False if there is no further step.

        Raises:
            DeviceError: the search ended without finding the switch, or was stopped.
        """
        home = self._channel.home() if self._found is None else self._found
        if home is None or self._cancelled or status.stopped:
            raise self._failed(status)
        if self._found is None and status.counts != home:
            self._found = home
            try:
                self._channel.go_home(home)
            finally:
                if self._cancelled:  # the stop may have been sent just before the move
                    self._channel.stop(hard=False)
            return True
        if status.counts != home:
            raise self._failed(status)
        self._channel.preset(self._home)
        return False

    def _failed(self, status: ChannelStatus) -> DeviceError:
        why = status.ending or ("stopped" if self._cancelled else "no reason given")
        return DeviceError(
            self._name,
            f"the search for the home switch stopped short ({why})",
            reply=status.raw,
            expected="to be on the home switch",
            advice="Check the switch and its settings on the controller's panel, then search again",
            state=(
                f"The stage is at {status.counts} counts, but the search is not complete, so the angle of the stage "
                "is unknown"
            ),
        )


class PM16CStage(LineStage):
    """Tsuji PM16C-04XD(L) as a rotation stage; see the module.

    Closing restores speed, acceleration and position controllers as they were found. During a move it restores nothing,
    and the move ends by itself. For arming and disarming, the stage must be at rest.

    Args:
        url: pyserial URL; the controller's LAN port is "socket://host:7777".
    """

    Settings = PM16CSettings

    def __init__(self, url: str, settings: PM16CSettings, clock: Clock, name: str = "stage") -> None:
        super().__init__(url, settings, clock, name)
        self._settings = settings
        self._home = None if settings.home is None else self._travel.to_counts(settings.home)
        self._search: HomeSearch | None = None
        self._channel = PM16CChannel(url, settings.channel, settings, clock, name)
        self._found = self._channel.found
        with self._closed_on_failure():
            self._version = self._channel.open(settings.rate_code)
            if (own := self._channel.own_limits()) is not None:
                self._travel.refuse_narrower(*own, advice="widen the limits on the controller's panel")

    @staticmethod
    def halt(url: str, settings: PM16CSettings, clock: Clock) -> None:
        with contextlib.closing(PM16CChannel(url, settings.channel, settings, clock, "stage")) as channel:
            channel.stop(hard=False)

    def _counts(self) -> int:
        return self._channel.counts()

    def start_move(self, angle: float, speed: float) -> None:
        target, per_radian = self._travel.target(angle), self.limits.counts_per_turn / (2 * math.pi)
        pps = self._travel.native(speed, per_radian, self._settings.fastest, "pulses/s")
        with self._stops.none_while("the move"):
            self._channel.start(target, pps)
        self._target, self._search = target, None

    def start_home(self) -> None:
        """Begin the search for the home switch; `wait` makes its later steps. An armed train is disarmed."""
        if self._home is None:
            raise DeviceRefused(
                self.name,
                "it has no home switch",
                advice="If there is a home switch, set its angle as `home_deg` in the configuration",
                state="Nothing has moved",
            )
        search = HomeSearch(self._channel, self.name, self._home)
        with self._stops.none_while("the search"):
            search.begin(self._settings.search_rate)
        self._target, self._search = self._home, search

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
            raise self._travel.still_moving(timeout, status.counts, self._aim, self._channel.last_move, status.raw)
        if target is not None and status.counts != target:
            raise DeviceError(
                self.name,
                f"it stopped short of {self._travel.degrees(target)} ({status.ending or 'no reason given'})",
                request=self._channel.last_move,
                reply=status.raw,
                expected=f"{self._travel.degrees(target)}, {target} counts",
                advice="Find what stopped the stage (limit switch, interlock, stop button) before you move it again",
                state=f"It is at {self._travel.degrees(status.counts)}, {status.counts} counts",
            )
        return self.to_angle(status.counts)

    def arm(self, train: TriggerTrain) -> None:
        self._travel.refuse_train(train)
        points, counts = points_of(train, self._settings.first_pulse), self._channel.standing("arming").counts
        self._travel.refuse_late_arming(train, counts, points.start)
        self._channel.arm(MODES[self._settings.widths.widest_for(train, self.limits)], points)

    def disarm(self) -> None:
        self._channel.disarm()

    def describe(self) -> dict[str, str | int | float]:
        return {
            "model": "Tsuji PM16C-04XD(L)",
            "firmware": self._version,
            "port": self._url,
            "channel": self._settings.channel,
            "trigger_output": "TP0",
            "pulse_width_s": self._settings.widths.chosen or "the widest that fits",
            "trigger_polarity": "active high",
            "first_pulse": self._settings.first_pulse.value,
            **found_at_opening(self._channel.error_at_opening, self._found.notice),
            **self._travel.described(),
        }

    def _release(self) -> None:
        self._channel.close()

    def _send_stop(self, hard: bool) -> str:
        if (search := self._search) is not None:
            search.cancel()
        return self._channel.stop(hard)

    def digital_output(self, number: int) -> DigitalOutput:
        raise DeviceRefused(
            self.name,
            f"the controller has no digital output {number} that can be set",
            advice="Set shutter.kind: manual, or use the output of another controller",
            state="Nothing was sent",
        )

    def _until_standing(self, timeout: float) -> ChannelStatus:
        """The status when the stage has stopped, or when the time is over."""
        return until_standing(self._clock, self._channel.status, lambda status: status.moving, timeout)
