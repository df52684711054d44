"""Simulated PI GCS 2.0 controller (C-863 class), the commands: what each does to the axis and the output lines.

A setting returns None, a query the lines of its reply. A wrong command raises the code for the
error register. One command takes one item (one axis, one parameter), as the C-863 does.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from simulators.wires.pi_gcs.axis import GcsAxis, GcsError, PiAxisBuild
from simulators.wires.pi_gcs.output import PiOutput

IDENTITY = "(c)2026 Physik Instrumente (PI) GmbH & Co. KG, C-863.12-SIMULATED, 0, 1.2.1.0"
DECIMALS = 6
MODES = (0, 2, 5, 6, 7, 8)


class PiGcsBox:
    """One axis with its identifier, and the output lines by number. Only one thread may use it."""

    def __init__(self, name: str, axis: GcsAxis, outputs: dict[int, PiOutput]) -> None:
        self.name, self.axis, self.outputs = name, axis, outputs
        self.levels = dict.fromkeys(outputs, False)
        """The states of the output lines that DIO has set."""

    def axis_of(self, arguments: list[str], more: int = 0) -> list[str]:
        """The arguments after the axis' name. A command without other arguments may leave the name out."""
        if not arguments and not more:
            return []
        if len(arguments) != more + 1:
            raise GcsError(24)
        if arguments[0] != self.name:
            raise GcsError(15)
        return arguments[1:]

    def output_of(self, arguments: list[str], more: int) -> tuple[PiOutput, list[str]]:
        if len(arguments) != more + 1:
            raise GcsError(24)
        number = _integer(arguments[0])
        if number not in self.outputs:
            raise GcsError(36)
        return self.outputs[number], arguments[1:]

    def status(self) -> int:
        """The register of #4."""
        axis = self.axis
        negative, reference, positive = axis.switches()
        bits = {15: axis.on_target(), 14: axis.referencing(), 13: axis.moving(), 12: axis.servo(), 8: axis.error != 0}
        bits |= {2: positive, 1: reference, 0: negative}
        return sum(1 << bit for bit, on in bits.items() if on)

    def read_error(self) -> int:
        self.axis.catch_up()
        code, self.axis.error = self.axis.error, 0
        return code


Action = Callable[[PiGcsBox, list[str]], list[str] | None]  # A command with its arguments


def _integer(text: str) -> int:
    if not re.fullmatch(r"[+-]?\d{1,9}|0[xX][0-9A-Fa-f]{1,8}", text, re.ASCII):
        raise GcsError(25)
    return int(text, 16) if "x" in text.lower() else int(text)


def _number(text: str, low: float, high: float, out_of_range: int = 17) -> float:
    if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?", text, re.ASCII):
        raise GcsError(25)
    if not low <= float(text) <= high:
        raise GcsError(out_of_range)
    return float(text)


def _place(box: PiGcsBox, arguments: list[str]) -> float:
    return _number(box.axis_of(arguments, 1)[0], -1e12, 1e12, 7)


def _plain(value: float) -> str:
    return f"{value + 0.0:.{DECIMALS}f}"


def _of_axis(value: Callable[[PiGcsBox], str]) -> Action:
    """A query of the axis: `1=value`."""

    def answer(box: PiGcsBox, arguments: list[str]) -> list[str]:
        box.axis_of(arguments)
        return [f"{box.name}={value(box)}"]

    return answer


def _switch(act: Callable[[PiGcsBox, bool], None]) -> Action:
    """A setting of the axis that is 0 or 1."""

    def do(box: PiGcsBox, arguments: list[str]) -> None:
        act(box, bool(_number(box.axis_of(arguments, 1)[0], 0, 1)))

    return do


def _rate(attribute: str, highest: Callable[[PiAxisBuild], float], error: int = 17) -> Action:
    """A velocity or acceleration in degrees, above 0."""

    def do(box: PiGcsBox, arguments: list[str]) -> None:
        value = _number(box.axis_of(arguments, 1)[0], 1e-9, highest(box.axis.build), error)
        setattr(box.axis, attribute, value)

    return do


def _act(act: Callable[[GcsAxis], None]) -> Action:
    """A command without a value that the axis obeys at once."""

    def do(box: PiGcsBox, arguments: list[str]) -> None:
        box.axis_of(arguments)
        act(box.axis)

    return do


def _halt(box: PiGcsBox, arguments: list[str] | None = None) -> None:
    box.axis.halt()


PARAMETERS = {0xB: "acceleration", 0xC: "deceleration"}


def _parameter(box: PiGcsBox, number: int) -> float:
    fixed = {0xE: box.axis.build.counts_per_turn, 0xF: 360}
    if number in fixed:
        return fixed[number]
    if number not in PARAMETERS:
        raise GcsError(54)
    return float(getattr(box.axis, PARAMETERS[number]))


def _tell_parameter(box: PiGcsBox, arguments: list[str]) -> list[str]:
    number = _integer(box.axis_of(arguments, 1)[0])
    return [f"{box.name} 0x{number:X}={_plain(_parameter(box, number))}"]


def _set_parameter(box: PiGcsBox, arguments: list[str]) -> None:
    number, value = box.axis_of(arguments, 2)
    if _integer(number) not in PARAMETERS:
        _parameter(box, _integer(number))
        raise GcsError(60)
    setattr(box.axis, PARAMETERS[_integer(number)], _number(value, 1e-9, box.axis.build.max_acceleration))


def _set_trigger(box: PiGcsBox, arguments: list[str]) -> None:
    output, (parameter, value) = box.output_of(arguments, 2)
    if output.on:
        box.axis.switch_trigger(output, False)  # a line that is on starts again with its new setting
        _set_trigger(box, arguments)
        box.axis.switch_trigger(output, True)
        return
    match _integer(parameter):
        case 1:
            output.step = _number(value, 1e-3 / box.axis.per_degree, 1e9)
        case 2 if value == box.name:
            output.axis = value
        case 2:
            raise GcsError(15)
        case 3 if _integer(value) in MODES:
            output.mode = _integer(value)
        case 7 if value in ("0", "1"):
            output.polarity = int(value)
        case 8:
            output.start = _number(value, -1e12, 1e12)
        case 9:
            output.stop = _number(value, -1e12, 1e12)
        case 3 | 7:
            raise GcsError(17)
        case _:
            raise GcsError(54)


def _tell_trigger(box: PiGcsBox, arguments: list[str]) -> list[str]:
    output, (parameter,) = box.output_of(arguments, 1)
    values = {
        1: _plain(output.step),
        2: output.axis,
        3: str(output.mode),
        7: str(output.polarity),
        8: _plain(output.start),
        9: _plain(output.stop),
    }
    if _integer(parameter) not in values:
        raise GcsError(54)
    return [f"{arguments[0]} {arguments[1]}={values[_integer(parameter)]}"]


def _switch_trigger(box: PiGcsBox, arguments: list[str]) -> None:
    output, (value,) = box.output_of(arguments, 1)
    box.axis.switch_trigger(output, bool(_number(value, 0, 1)))


def _put_output(box: PiGcsBox, arguments: list[str]) -> None:
    _, (level,) = box.output_of(arguments, 1)
    if level not in ("0", "1"):
        raise GcsError(17)
    box.levels[int(arguments[0])] = level == "1"


def _trigger_is_on(box: PiGcsBox, arguments: list[str]) -> list[str]:
    if not arguments:
        return [f"{number}={output.on:d}" for number, output in box.outputs.items()]
    output, _ = box.output_of(arguments, 0)
    return [f"{arguments[0]}={output.on:d}"]


SINGLE: dict[int, Callable[[PiGcsBox], list[str] | None]] = {
    0x04: lambda box: [f"0x{box.status():04X}"],
    0x05: lambda box: [f"{box.axis.moving():X}"],
    0x07: lambda box: ["\xb0" if box.axis.referencing() else "\xb1"],
    0x18: _halt,
}

COMMANDS: dict[str, Action] = {
    "*IDN?": lambda box, arguments: [IDENTITY],
    "CSV?": lambda box, arguments: ["2.0"],
    "ERR?": lambda box, arguments: [str(box.read_error())],
    "SAI?": lambda box, arguments: [box.name],
    "SVO": _switch(lambda box, on: box.axis.switch_servo(on)),
    "SVO?": _of_axis(lambda box: f"{box.axis.servo():d}"),
    "FRF": _act(lambda axis: axis.reference("FRF")),
    "FNL": _act(lambda axis: axis.reference("FNL")),
    "FPL": _act(lambda axis: axis.reference("FPL")),
    "FRF?": _of_axis(lambda box: f"{box.axis.referenced:d}"),
    "TRS?": _of_axis(lambda box: f"{box.axis.build.reference_switch:d}"),
    "LIM?": _of_axis(lambda box: f"{box.axis.build.limit_switches:d}"),
    "POS?": _of_axis(lambda box: _plain(box.axis.position())),
    "TMN?": _of_axis(lambda box: _plain(box.axis.build.low)),
    "TMX?": _of_axis(lambda box: _plain(box.axis.build.high)),
    "MOV": lambda box, arguments: box.axis.move_to(_place(box, arguments)),
    "MVR": lambda box, arguments: box.axis.move_to(box.axis.target() + _place(box, arguments)),
    "MOV?": _of_axis(lambda box: _plain(box.axis.target())),
    "ONT?": _of_axis(lambda box: f"{box.axis.on_target():d}"),
    "VEL": _rate("velocity", lambda build: build.max_velocity, 8),
    "VEL?": _of_axis(lambda box: _plain(box.axis.velocity)),
    "ACC": _rate("acceleration", lambda build: build.max_acceleration),
    "ACC?": _of_axis(lambda box: _plain(box.axis.acceleration)),
    "DEC": _rate("deceleration", lambda build: build.max_acceleration),
    "DEC?": _of_axis(lambda box: _plain(box.axis.deceleration)),
    "SPA": _set_parameter,
    "SPA?": _tell_parameter,
    "HLT": _act(GcsAxis.brake),
    "STP": _halt,
    "DIO": _put_output,
    "CTO": _set_trigger,
    "CTO?": _tell_trigger,
    "TRO": _switch_trigger,
    "TRO?": _trigger_is_on,
}
