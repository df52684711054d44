"""Simulated Zaber device behind its wire: settings, commands, and the trigger cable from one digital output.

A controller with one rotary axis, X-RSW style. It rejects unknown commands with BADCOMMAND, as a device does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from drivers.base.clock import Clock
from simulators.devices.trigger_line import Pulse, TriggerLine
from tests.simulators.wires.zaber.axis import Rejected, SimulatedZaberAxis, ZaberAxisBuild
from tests.simulators.wires.zaber.triggers import ACTIONS, OUTPUTS, TRIGGERS, Edge, Triggers, is_output, number_in

LOOK_AHEAD = 10.0  # s beyond the end of a move for which edges are predicted
WRITABLE = {"maxspeed", "motion.accelonly", "motion.decelonly", "limit.min", "limit.max"}
NOTHING = "0"


@dataclass(frozen=True)
class DeviceBuild:
    """How the device is built, and its faults.

    Attributes:
        output: digital output (from 1) that is wired to the line.
        active_high: whether the camera triggers on that output's rising edge.
        firmware: version; triggers came with 7.06.
        can_schedule: it has `io set do N V schedule MS W`; can_chain: an action may enable another trigger.
        identity: the name of the setting with the device's identity number: "device.id" or "deviceid".
        latency: s from a trigger's condition to its actions.
        fires_when_enabled: a distance trigger fires where it is enabled, too.
    """

    output: int = 1
    active_high: bool = True
    firmware: str = "7.38"
    can_schedule: bool = True
    can_chain: bool = True
    identity: str = "device.id"
    latency: float = 0.0
    fires_when_enabled: bool = False
    axis: ZaberAxisBuild = field(default=ZaberAxisBuild())


class ZaberDevice:
    """State and actions of the device; `do` raises Rejected with the device's reason. Not safe from several threads."""

    def __init__(self, clock: Clock, line: TriggerLine, build: DeviceBuild) -> None:
        now, counts_per_turn = clock.now(), build.axis.counts_per_turn
        self.axis = SimulatedZaberAxis(now, build.axis)
        self.axis.settings["limit.cycle.dist"] = counts_per_turn
        self.triggers = Triggers(self.axis.move, build.latency, build.fires_when_enabled, now)
        self.alerts, self.checksums = False, False
        self._clock, self._line = clock, line
        self._output, self._active = build.output - 1, int(build.active_high)
        self.triggers.outputs[self._output] = 1 - self._active
        self._can_schedule, self._can_chain = build.can_schedule, build.can_chain
        self._has_triggers = tuple(map(int, build.firmware.split("."))) >= (7, 6)
        self._angle_of_count = 2 * math.pi / counts_per_turn
        self._sent: set[Pulse] = set()
        self._looked = 0  # past edges that were processed
        self._fixed: dict[str, str] = {
            build.identity: "50952",
            "system.serial": "123456",
            "version": build.firmware,
            "comm.address": "1",
            "trigger.numtriggers": str(TRIGGERS),
            "trigger.numactions": str(ACTIONS),
        }

    def settle(self) -> bool:
        """Process all events up to now; returns whether a move has ended since the last call."""
        now = self._clock.now()
        self.triggers.advance(now)
        self._emit(now, self._happened())
        return self.axis.settle(now)

    def do(self, axis: int, words: Sequence[str]) -> str:
        """One command; the data of its reply."""
        match words:
            case []:
                return NOTHING
            case ["get", setting]:
                return self._get(axis, setting)
            case ["warnings", *clear] if clear in ([], ["clear"]):
                flags = self.axis.warnings()
                if clear:
                    self.axis.flags.clear()
                return " ".join([f"{len(flags):02d}", *flags])
            case ["trigger", "show"] if self._has_triggers:
                states = {0: "d", -1: "e"}  # disabled, enabled without end; else the fires that are left
                return " ".join(states.get(trigger.left, str(trigger.left)) for trigger in self.triggers.triggers)
            case ["io", "get", "do", channel] if number_in(channel, OUTPUTS):
                return str(self.triggers.outputs[int(channel) - 1])
            case ["io", "get", "do"]:
                return " ".join(map(str, self.triggers.outputs))
        self._change(axis, words)
        self._predict()
        return NOTHING

    def information(self, words: Sequence[str]) -> list[str]:
        """The info lines of a command, if it has any."""
        match words:
            case ["trigger", number, "print"] if self._has_triggers and number_in(number, TRIGGERS):
                trigger = self.triggers.triggers[int(number) - 1]
                actions = [f"action {letter} {text}" for letter, text in zip("ab", trigger.actions, strict=True)]
                enabled = f"enable {trigger.total if trigger.total > 0 else ''}".rstrip() if trigger.left else "disable"
                return [f"when {trigger.text}", *actions, enabled]
        return []

    def _get(self, axis: int, setting: str) -> str:
        now = self._clock.now()
        if setting in self._fixed or setting in ("comm.alert", "comm.checksum"):
            if axis:
                raise Rejected("DEVICEONLY")
            live = {"comm.alert": str(int(self.alerts)), "comm.checksum": str(int(self.checksums))}
            return self._fixed.get(setting) or live[setting]
        if setting in ("pos", "encoder.pos"):
            return str(self.axis.position(now))
        if setting == "accel":
            setting = "motion.accelonly"
        if setting in self.axis.settings:
            return str(self.axis.settings[setting])
        raise Rejected("BADCOMMAND")

    def _change(self, axis: int, words: Sequence[str]) -> None:
        now, here = self._clock.now(), self.axis.move.position(self._clock.now())
        match words:
            case ["home"]:
                self.axis.home(now)
            case ["move", "abs", position]:
                self.axis.start(now, _whole(position))
            case ["move", "rel", distance]:
                self.axis.start(now, self.axis.position(now) + _whole(distance))
            case ["stop"]:
                self.axis.stop(now)
            case ["estop"]:
                self.axis.halt(now)
            case ["driver", ("enable" | "disable") as wanted]:
                self.axis.halt(now)
                self.axis.enabled = wanted == "enable"
            case ["set", setting, value]:
                self._set(axis, setting, _whole(value))
            case ["io", "set", "do", channel, value, *schedule] if is_output(channel, value, schedule):
                self._check_schedule(schedule)
                self.triggers.act(list(words), here)
            case ["trigger", number, *rest] if self._has_triggers:
                if not number_in(number, TRIGGERS):
                    raise Rejected("BADDATA")
                self._set_trigger(int(number) - 1, rest, here)
            case _:
                raise Rejected("BADCOMMAND")
        self.triggers.move = self.axis.move

    def _set(self, axis: int, setting: str, value: int) -> None:
        if setting in ("comm.alert", "comm.checksum"):
            if axis:
                raise Rejected("DEVICEONLY")
            if value not in (0, 1):
                raise Rejected("BADDATA")
            if setting == "comm.alert":
                self.alerts = bool(value)
            else:
                self.checksums = bool(value)
            return
        names = ["motion.accelonly", "motion.decelonly"] if setting == "accel" else [setting]
        if not set(names) <= WRITABLE:
            raise Rejected("BADCOMMAND")
        if value < 1 and not setting.startswith("limit"):
            raise Rejected("BADDATA")
        self.axis.settings.update(dict.fromkeys(names, value))

    def _set_trigger(self, number: int, words: Sequence[str], here: float) -> None:
        match words:
            case ["when", *condition]:
                self.triggers.configure(number, condition)
            case ["action", ("a" | "b") as letter, *action]:
                self._check_schedule(action)
                if "trigger" in action and not self._can_chain:
                    raise Rejected("BADDATA")
                self.triggers.set_action(number, letter, action)
            case ["enable", *count] if not count or (len(count) == 1 and count[0].isdigit()):
                self.triggers.enable(number, int(count[0]) if count else 0, here)
            case ["disable"]:
                self.triggers.disable(number)
            case _:
                raise Rejected("BADDATA")

    def _check_schedule(self, words: Sequence[str]) -> None:
        if "schedule" in words and not self._can_schedule:
            raise Rejected("BADDATA")

    def _predict(self) -> None:
        """Put the future pulses, as now predicted, on the line, in place of those predicted earlier."""
        now = self._clock.now()
        happened = self._happened()
        coming = self.triggers.predicted(max(now, self.axis.move.end) + LOOK_AHEAD)
        self._line.cancel_after(now)
        self._emit(now, happened + self._pulses(coming))

    def _happened(self) -> list[Pulse]:
        """Pulses since the last call."""
        new = self.triggers.edges[self._looked :]
        self._looked += len(new)
        return self._pulses(new)

    def _emit(self, now: float, pulses: list[Pulse]) -> None:
        """Put pulses on the line, without the past ones that it already has."""
        if new := [pulse for pulse in pulses if pulse.time > now or pulse not in self._sent]:
            self._line.schedule(new)
            self._sent.update(new)

    def _pulses(self, edges: Sequence[Edge]) -> list[Pulse]:
        active = self._output, self._active
        return [
            Pulse(edge.time, edge.position * self._angle_of_count)
            for edge in edges
            if (edge.channel, edge.value) == active
        ]


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise Rejected("BADDATA") from None
