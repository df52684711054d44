"""Zaber rotary stage with triggers (ASCII protocol, firmware 7.06 or later): pulses on a digital output at equal
distances.

Positions are commanded microsteps unless `measured`. Facts about the firmware that are from memory are settings, see
`ZaberSettings`.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import TriggerTrain
from drivers.stages.shared import LineStage, StageOutput, found_at_opening, refuse_another, until_standing
from drivers.stages.travel import Travel
from drivers.stages.zaber.axis import INTERRUPTED, LOST, SLIPPED, WHOLE, ZaberAxis, ZaberAxisStatus, meaning_of
from drivers.stages.zaber.settings import ZaberSettings, set_up

ADVICE = (
    "For firmware without `schedule`, set toggle: true. For firmware whose actions cannot enable triggers, set "
    "chained: false and leave room for one step before the first pulse"
)


STANDING_IN_PLACE = 10.0  # s; a short move has failed after twice its expected time plus this


class ZaberStage(LineStage):
    """Zaber rotary stage; see the module.

    Closing does not stop a move. It disarms a train, and restores speed, acceleration and checksums. A move against the
    direction of a train that has begun disarms the train, because the controller counts distance in both directions. If
    triggers are not `chained`, `arm` turns the stage to one step before the first pulse and waits. Then the stage still
    accelerates during the first pulses.

    Args:
        url: pyserial URL; a controller's LAN port is "socket://host:55550".
    """

    Settings = ZaberSettings

    def __init__(self, url: str, settings: ZaberSettings, clock: Clock, name: str = "stage") -> None:
        super().__init__(url, settings, clock, name)
        self._settings, (self._fastest, steepest) = settings, settings.native_limits
        self._reported = frozenset[str]()  # flags that an error or the description has already reported
        self._train: TriggerTrain | None = None
        self._touched = True  # the armed triggers; None after they were disabled
        self._axis = ZaberAxis(url, settings, clock, name)
        self._found = self._axis.found
        with self._closed_on_failure():
            self._identity = self._axis.open()
            refuse_another(name, settings.serial, self._identity["serial"])
            self._reported = frozenset(self._axis.flags_at_opening)
            self._check_turn_and_travel()
            self._axis.ask_axis(f"set accel {steepest}")
            version = [int(part) for part in self._identity["firmware"].split(".")]
            self._travel = Travel(name, replace(settings.limits(), trigger_output=version >= [7, 6]))
            self.disarm()  # a train left by a program that died

    @staticmethod
    def halt(url: str, settings: ZaberSettings, clock: Clock) -> None:
        with contextlib.closing(ZaberAxis(url, settings, clock, "stage")) as axis:
            axis.stop("stop")

    def _counts(self) -> int:
        return self._axis.status().counts

    def start_move(self, angle: float, speed: float) -> None:
        self._start_move(angle, speed, self._stops.count)

    def _start_move(self, angle: float, speed: float, stops: int) -> None:
        """`stops`: number of stops before the move; a later stop cancels the move."""
        target = self._travel.target(angle)
        per_radian = self.limits.counts_per_turn / (2 * math.pi) * self._settings.speed_unit
        native = self._travel.native(speed, per_radian, self._fastest, "native units")
        with self._stops.none_while("the move", stops):
            status = self._axis.standing("a move")
            if not status.referenced:
                raise DeviceRefused(
                    self.name,
                    "a move is not possible, because the position has no reference",
                    reply=status.raw,
                    advice="Search the reference (home) first",
                    state="Nothing has moved",
                )
            self._refuse_unreported(status)
            self._before_move(status.counts, target)
            self._forget_flags(status)
            self._axis.ask_axis(f"set maxspeed {native}")
            self._axis.begin(f"move abs {target}")
        self._target, self._searching = target, False

    def start_home(self) -> None:
        """Begin the search for the reference, at the controller's own speed and acceleration for searches."""
        with self._stops.none_while("the search for the reference"):
            status = self._axis.standing("a search for the reference")
            self.disarm()
            self._forget_flags(status)
            self._axis.begin("home")
        self._target, self._searching = None, True

    def moving(self) -> bool:
        return self._axis.status().moving

    def wait(self, timeout: float) -> float:
        status = until_standing(self._clock, self._axis.status, lambda status: status.moving, timeout)
        aim = self._aim
        if status.moving:
            raise self._travel.still_moving(timeout, status.counts, aim, self._axis.last_move, status.raw)
        fault = meaning_of(status.flags)
        if self._searching:
            arrived = status.referenced and INTERRUPTED not in status.flags
        else:
            arrived = self._target is None or status.counts == self._target
        if not arrived or (aim and status.grave):
            self._reported = frozenset(status.flags)
            raise DeviceError(
                self.name,
                f"a fault at {aim}" if arrived else f"it stopped short of {aim}",
                request=self._axis.last_move,
                reply=status.raw,
                expected=f"to be at {aim} without a fault",
                advice="Find what stopped the stage before you move it again" if fault is None else fault.advice,
                state=f"It is at {self._travel.degrees(status.counts)}, {status.counts} counts: "
                + ("no reason given" if fault is None else fault.text),
            )
        self._searching = False
        return self.to_angle(status.counts)

    def arm(self, train: TriggerTrain) -> None:
        self._travel.refuse_train(train)
        if not self.limits.trigger_output:
            raise DeviceRefused(
                self.name,
                f"its firmware {self._identity['firmware']} has no triggers",
                expected="7.06 or later",
                advice="Update the firmware with the vendor's software",
                state="Nothing has moved, and the stage will send no trigger pulses",
            )
        stops, counts = self._stops.count, self._axis.standing("arming").counts
        self._travel.refuse_late_arming(train, counts)
        self._set_up(train, counts, stops)

    def disarm(self) -> None:
        """Disarm the trigger output; allowed in every state. The output is reset."""
        if self._touched and self.limits.trigger_output:
            for command in self._settings.quiet:
                self._axis.ask(command)
            self._train, self._touched = None, False

    def describe(self) -> dict[str, str | int | float]:
        settings, flags = self._settings, meaning_of(self._axis.flags_at_opening)
        return {
            **self._identity,
            "port": self._url,
            "device": settings.device,
            "axis": settings.axis,
            "trigger_output": f"digital output {settings.output}",
            "trigger_position": "encoder" if settings.measured else "commanded",
            "pulse_width_s": "half an interval" if settings.toggle else settings.milliseconds / 1000,
            "pulse_active_high": int(settings.active_high),
            **found_at_opening("" if flags is None else flags.text, self._found.notice),
            **self._travel.described(),
        }

    def digital_output(self, number: int) -> StageOutput:
        if number == self._settings.output:
            raise DeviceRefused(self.name, f"output {number} gives the trigger pulses", state="Nothing was sent")

        def set_to(high: bool) -> None:
            self._axis.ask(f"io set do {number} {int(high)}")

        return StageOutput(
            f"{self.name} output {number}",
            set_to,
            lambda: self._axis.ask(f"io get do {number}", "[01]") == "1",
        )

    def _release(self) -> None:
        with contextlib.suppress(DeviceError):
            self.disarm()
        self._axis.close()

    def _refuse_unreported(self, status: ZaberAxisStatus) -> None:
        """Raise DeviceError, once, if something disturbed the stage since its last move."""
        if not (status.grave & (SLIPPED | LOST)) - self._reported:
            return
        self._reported = frozenset(status.flags)
        fault = meaning_of(status.flags)
        assert fault is not None, status.flags
        raise DeviceError(
            self.name,
            f"the stage was disturbed since its last move: {fault.text}",
            reply=status.raw,
            expected="a stage at rest",
            advice=f"{fault.advice}. Frames taken since that move may have another angle than stated",
            state=f"Nothing has moved because of this request; the stage is at {self._travel.degrees(status.counts)}",
        )

    def _forget_flags(self, status: ZaberAxisStatus) -> None:
        if status.flags:
            self._axis.ask_axis("warnings clear")
        self._reported = frozenset()

    def _send_stop(self, hard: bool) -> str:
        return self._axis.stop("estop" if hard else "stop")

    def _set_up(self, train: TriggerTrain, counts: int, stops: int) -> None:
        """Set up the triggers with the stage at `counts`, and enable the first one.

        Args:
            stops: number of stops before; a later stop cancels this.
        """
        (*commands, enable), stand = set_up(self._settings, train, counts)
        self._train, self._touched = None, True
        try:
            for command in commands:
                self._axis.ask(command)
            if stand != counts:
                way = abs(self.to_angle(stand - counts)) / self.limits.max_speed
                self._start_move(self.to_angle(stand), self.limits.max_speed, stops)
                self.wait(2 * way + STANDING_IN_PLACE)
            self._axis.ask(enable)
        except DeviceRefused as problem:
            raise problem.told_by(
                self.name,
                f"the triggers cannot be set up: {problem.problem}",
                advice=ADVICE,
                state="The stage will send no trigger pulses",
            ) from problem
        self._train = train

    def _before_move(self, counts: int, target: int) -> None:
        """Keep a train correct before a move from `counts` against its direction, because distance counts in both
        directions.

        A train that has begun is disarmed. A train before its first pulse is set up again, or disarmed if the stage
        would have to move for this.
        """
        train, settings = self._train, self._settings
        if train is None or train.interval * (target - counts) >= 0:
            return
        # for each trigger `d` (disabled), `e` or the number of remaining fires
        needed = max(settings.starter, settings.repeater)
        states = self._axis.ask("trigger show", rf"(?:[de]|\d+)(?: (?:[de]|\d+)){{{needed - 1},}}").split()
        if settings.chained and states[settings.starter - 1] != "d":
            return
        if settings.chained and states[settings.repeater - 1] == str(settings.fires * train.n):
            self._set_up(train, counts, self._stops.count)
        else:
            self.disarm()

    def _check_turn_and_travel(self) -> None:
        own = self._axis.get_if_known("limit.cycle.dist", self._settings.axis)
        if own is None or float(own) != self.limits.counts_per_turn:
            raise DeviceRefused(
                self.name,
                "the device has no limit.cycle.dist, so it is not a rotary stage"
                if own is None
                else f"a turn has {own} microsteps",
                expected=f"{self.limits.counts_per_turn} a turn, as configured",
                advice="Correct counts_per_turn, or check device and axis",
                state="Nothing has moved",
            )
        low, high = (int(self._axis.ask_axis(f"get limit.{end}", WHOLE)) for end in ("min", "max"))
        self._travel.refuse_narrower(low, high, advice="widen the controller's limits")
