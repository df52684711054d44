"""Conditions of simulated Zaber triggers, and what of `when` and `io set do` a stand-in understands."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from simulators.wires.zaber.axis import Rejected

OUTPUTS, INPUTS = 4, 4
OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "==": operator.eq,
    "!=": operator.ne,
    ">": operator.gt,
    ">=": operator.ge,
    "<": operator.lt,
    "<=": operator.le,
}


@dataclass(frozen=True)
class Distance:
    """Each `step` microsteps of travel."""

    step: int


@dataclass(frozen=True)
class Compare:
    """The position, or its absolute value, compared with a value."""

    sign: str
    value: int
    absolute: bool

    def holds(self, position: float) -> bool:
        return OPERATORS[self.sign](abs(position) if self.absolute else position, self.value)


@dataclass(frozen=True)
class Every:
    """Each `seconds`."""

    seconds: float


@dataclass(frozen=True)
class Input:
    """A digital input compared with a value; inputs change by `Triggers.set_input`."""

    channel: int
    sign: str
    value: int


Condition = Distance | Compare | Every | Input


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
    """What `when` says; positions of the axis are all that this stand-in compares."""
    try:
        match list(words):
            case [("0" | "1"), "dist", step] | [("0" | "1"), "encoder", "dist", step] if int(step) > 0:
                return Distance(int(step))
            case [("0" | "1"), ("pos" | "encoder.pos"), sign, value] if sign in OPERATORS:
                return Compare(sign, int(value), absolute=False)
            case [("0" | "1"), "abs", ("pos" | "encoder.pos"), sign, value] if sign in OPERATORS:
                return Compare(sign, int(value), absolute=True)
            case ["time", ms] if float(ms) >= 1:
                return Every(float(ms) / 1000)
            case ["io", "di", channel, sign, value] if number_in(channel, INPUTS) and sign in OPERATORS:
                return Input(int(channel) - 1, sign, int(value))
    except ValueError:
        pass
    raise Rejected("BADDATA")
