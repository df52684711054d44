"""Simulated Zaber triggers and digital outputs: conditions on a moving axis, two actions each, edges with their times.

Nothing runs in the background: `advance` goes from event to event up to a time, and a copy that is advanced beyond it
predicts the edges still to come. A trigger fires when its condition turns true, as in the vendor's library. It fires at
once if the condition is true when it is enabled; COUNT fires disable it. From memory, not confirmed: a distance
counts in both directions from the place of enabling or of the last fire. A new value of an output cancels its
schedule.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from simulators.devices.motion import TrapezoidMove
from tests.simulators.wires.zaber.axis import Rejected

OUTPUTS, TRIGGERS, ACTIONS = 4, 6, 2
UNLIMITED = -1
DEEPEST = 2 * TRIGGERS  # Triggers may set each other off so often at one moment; more count as a circle


@dataclass(frozen=True)
class Distance:
    """Each `step` microsteps of travel."""

    step: int


@dataclass(frozen=True)
class Compare:
    """The position compared with a value: `>=`, or `<=` where `below`."""

    below: bool
    value: int

    def holds(self, position: float) -> bool:
        return position <= self.value if self.below else position >= self.value


Condition = Distance | Compare


@dataclass(frozen=True)
class Edge:
    """A digital output takes a new value, with the axis at `position` microsteps."""

    time: float
    channel: int
    value: int
    position: float


@dataclass
class Trigger:
    """Set-up and state of a trigger. `left` fires remain; distances count from `origin`."""

    text: str = "none"
    condition: Condition | None = None
    actions: list[str] = field(default_factory=lambda: ["none"] * ACTIONS)
    left: int = 0
    total: int = 0
    origin: float = 0.0
    met: bool = False


@dataclass
class Triggers:
    """The triggers and outputs of a device with one axis. Times are s, positions microsteps.

    Attributes:
        latency: s from a condition to its actions.
        fires_when_enabled: a distance trigger fires at the very point of enabling, too.
    """

    move: TrapezoidMove
    latency: float = 0.0
    fires_when_enabled: bool = False
    now: float = -math.inf
    triggers: list[Trigger] = field(default_factory=lambda: [Trigger() for _ in range(TRIGGERS)])
    outputs: list[int] = field(default_factory=lambda: [0] * OUTPUTS)
    edges: list[Edge] = field(default_factory=list)
    queue: list[tuple[float, int, str]] = field(default_factory=list)
    """Scheduled commands, the next one first."""
    serial: int = 0
    depth: int = 0

    # set by the host

    def configure(self, number: int, words: Sequence[str]) -> None:
        """Set the condition of `when`; this disables the trigger."""
        condition = condition_of(words)
        trigger = self.triggers[number]
        trigger.condition, trigger.text, trigger.left, trigger.total = condition, " ".join(words), 0, 0

    def set_action(self, number: int, letter: str, words: Sequence[str]) -> None:
        text = " ".join(words)
        if text != "none" and not self._known(list(words)):
            raise Rejected("BADDATA")
        self.triggers[number].actions["ab".index(letter)] = text

    def enable(self, number: int, count: int, position: float) -> None:
        """Enable the trigger; `count` 0 is without end."""
        trigger = self.triggers[number]
        if trigger.condition is None:
            raise Rejected("BADDATA")
        trigger.left = trigger.total = count or UNLIMITED
        trigger.origin = position
        trigger.met = isinstance(trigger.condition, Compare) and trigger.condition.holds(position)
        if trigger.met or (self.fires_when_enabled and isinstance(trigger.condition, Distance)):
            self._fire(trigger, position)

    def disable(self, number: int) -> None:
        self.triggers[number].left = 0

    # time

    def advance(self, to: float) -> None:
        """Process all events up to the time `to`."""
        while (event := self._next()) is not None and event[0] <= to:
            time, position, trigger = event
            self.now = max(self.now, time)
            if trigger is None:
                self.act(heapq.heappop(self.queue)[2].split(), position)
            elif isinstance(trigger.condition, Compare):
                trigger.met = trigger.condition.holds(position)
                if trigger.met:
                    self._fire(trigger, position)
            else:
                trigger.origin = position
                self._fire(trigger, position)
        self.now = max(self.now, to)

    def predicted(self, until: float) -> list[Edge]:
        """The edges from now to `until` if nobody does anything."""
        coming = replace(
            self,
            triggers=[replace(trigger, actions=list(trigger.actions)) for trigger in self.triggers],
            outputs=list(self.outputs),
            queue=list(self.queue),
            edges=[],
        )
        coming.advance(until)
        return coming.edges

    def act(self, words: list[str], position: float) -> None:
        """A command of an action, a host or a schedule, known to be well formed, with the axis at `position`."""
        match words:
            case ["io", "set", "do", channel, value, *schedule]:
                at = int(channel) - 1
                self.queue = [entry for entry in self.queue if not entry[2].startswith(f"io set do {channel} ")]
                heapq.heapify(self.queue)
                new = 1 - self.outputs[at] if value == "t" else int(value)
                if new != self.outputs[at]:
                    self.outputs[at] = new
                    self.edges.append(Edge(self.now, at, new, position))
                if schedule:
                    self._later(float(schedule[1]) / 1000, f"io set do {channel} {schedule[2]}")
            case ["trigger", number, "enable", *count]:
                self.enable(int(number) - 1, int(count[0]) if count else 0, position)
            case ["trigger", number, "disable"]:
                self.disable(int(number) - 1)

    def _known(self, words: list[str]) -> bool:
        """An action that this simulation knows: outputs and other triggers."""
        match words:
            case ["0", *rest] if rest and not rest[0].isdigit():
                return self._known(rest)
            case ["io", "set", "do", channel, value, *schedule]:
                return is_output(channel, value, schedule)
            case ["trigger", number, "enable", *count]:
                return number_in(number, TRIGGERS) and (not count or (len(count) == 1 and count[0].isdigit()))
            case ["trigger", number, "disable"]:
                return number_in(number, TRIGGERS)
        return False

    def _later(self, seconds: float, command: str) -> None:
        self.serial += 1
        heapq.heappush(self.queue, (self.now + seconds, self.serial, command))

    def _fire(self, trigger: Trigger, position: float) -> None:
        if self.depth > DEEPEST:
            return
        if trigger.left > 0:
            trigger.left -= 1
        self.depth += 1
        for action in trigger.actions:
            words = action.removeprefix("0 ").split()
            if self.latency > 0 and action != "none":
                self._later(self.latency, " ".join(words))
            elif action != "none":
                self.act(words, position)
        self.depth -= 1

    def _next(self) -> tuple[float, float, Trigger | None] | None:
        """(time, position, trigger) of the next event; without a trigger for a scheduled command."""
        events: list[tuple[float, float, Trigger | None]] = []
        if self.queue:
            events.append((self.queue[0][0], self.move.position(self.queue[0][0]), None))
        for trigger in self.triggers:
            if trigger.left and (event := self._change(trigger)) is not None:
                events.append((*event, trigger))
        return min(events, key=lambda event: event[0], default=None)

    def _change(self, trigger: Trigger) -> tuple[float, float] | None:
        """When and where an enabled trigger's condition changes next."""
        condition, move, here = trigger.condition, self.move, self.move.position(self.now)
        points: list[float] = []
        if isinstance(condition, Distance):
            points = [trigger.origin + move.direction * condition.step]
        elif isinstance(condition, Compare):
            points = [condition.value + move.direction * by for by in (-1, 0, 1)]
            points = [at for at in points if condition.holds(at) != trigger.met and move.direction * (at - here) > -0.5]
        if not points or self.now >= move.end or move.direction * (move.target - points[0]) < 0:
            return None
        return max(move.time_at(points[0]), self.now), points[0]


def number_in(text: str, most: int) -> bool:
    """1 to `most`."""
    return text.isdigit() and 1 <= int(text) <= most


def is_output(channel: str, value: str, schedule: Sequence[str]) -> bool:
    """`N 0|1|t`, or with `schedule MS 0|1`."""
    good = number_in(channel, OUTPUTS) and value in ("0", "1", "t")
    if not schedule:
        return good
    try:
        return (
            good
            and len(schedule) == 3
            and schedule[0] == "schedule"
            and float(schedule[1]) > 0
            and schedule[2] in "01t"
        )
    except ValueError:
        return False


def condition_of(words: Sequence[str]) -> Condition:
    """The condition of `when`: a distance, or >= or <= of the position; commanded and encoder position are equal."""
    try:
        match list(words):
            case [("0" | "1"), "dist", step] | [("0" | "1"), "encoder", "dist", step] if int(step) > 0:
                return Distance(int(step))
            case [("0" | "1"), ("pos" | "encoder.pos"), (">=" | "<=") as sign, value]:
                return Compare(sign == "<=", int(value))
    except ValueError:
        pass
    raise Rejected("BADDATA")
