"""One axis of a PI GCS 2.0 controller and its trigger line: commands and queries, in counts here and degrees there.

ERR? follows every set command, and important values are read back. Protocol: manual of the C-863 (MS249E),
cross-checked with the software of EPICS and of the vendor. Each line has one axis and one parameter; no daisy chain.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from drivers.base.errors import DeviceRefused
from drivers.stages.pi_gcs.line import (
    ANY_NUMBER,
    NOT_ALLOWED_TO_MOVE,
    NUMBER,
    REFUSALS,
    UNKNOWN_COMMAND,
    GcsLine,
    advice,
    is_rounding_of,
    meaning,
    plain,
)
from drivers.stages.pi_gcs.settings import PiGcsSettings, TriggerWindow
from drivers.stages.shared import FoundSettings, while_it_moves

ARE_THEY_MOVING, READY, REGISTER, STOP_ALL = b"\x05", b"\x07", b"\x04", b"\x18"
ACCELERATION, DECELERATION, NUMERATOR, DENOMINATOR = "0xB", "0xC", "0xE", "0xF"
RATE_AGREES = Fraction(1, 100)
"""Controllers round velocities and accelerations to their own steps. A larger relative difference is an error."""


@dataclass(frozen=True)
class PiAxisStatus:
    """State of the axis. `raw`: the replies, for error messages."""

    counts: int
    homed: bool
    servo: bool
    raw: str


class PiGcsAxis:
    """One axis. All methods raise the errors of `GcsLine`, and DeviceRefused if the axis moves but must be at rest."""

    def __init__(self, line: GcsLine, settings: PiGcsSettings, name: str) -> None:
        self._line, self._name, self._axis, self._output = line, name, settings.axis, settings.trigger_line
        self._counts_per_turn = settings.counts_per_turn
        self._bit = 0
        self.last_move = ""
        """The command of the last move or search, for error messages."""
        self._identity = ""
        self.error_at_opening = 0
        """The code in the error register before opening cleared it."""
        self.found = FoundSettings()
        """VEL and the accelerations in degrees, by the commands that set them."""

    def degrees(self, counts: Fraction | int) -> str:
        """A position, distance or rate in degrees as text; rounding errors over any train are far below a count."""
        return plain(Fraction(counts) * 360 / self._counts_per_turn)

    def to_counts(self, degrees: str) -> int:
        return round(Fraction(degrees) * self._counts_per_turn / 360)

    def open(self, acceleration: Fraction) -> str:
        """Identify the controller and prepare the axis: trigger off, servo on, acceleration (counts/s²).

        Returns its name.
        """
        self._line.wake()
        self._identity = self._line.ask("*IDN?", r".*Physik Instrumente.*", "the identity of a PI controller")[0]
        if self._line.ask("CSV?", r"(\d+)(?:\.\d+)?", "the version of the command language")[1] != "2":
            raise self._refused(f"{self._identity} does not use GCS 2.0", "Use a controller with command syntax 2.0")
        self.error_at_opening = self._line.read_error()
        axes = [line.strip() for line in self._line.ask("SAI?", r"[\w\s-]+", "the names of its axes")[0].split("\n")]
        if self._axis not in axes:
            raise self._refused(f"it has no axis {self._axis!r}, but {', '.join(axes)}", "Correct the configured axis")
        self._bit = axes.index(self._axis)
        self.standing("opening")
        self._compare_counts()
        self.disarm()
        if not self._line.flag("SVO?"):
            self._line.set(f"SVO {self._axis} 1")
            if not self._line.flag("SVO?"):
                raise self._line.not_followed(f"SVO {self._axis} 1", "0", "1")
        self.found.values["VEL"] = self._line.number("VEL?")
        self._take_accelerations(acceleration)
        self._line.fault = 0
        return self._identity

    def own_limits(self) -> tuple[int, int]:
        """The controller's own travel range in counts, limited to 10⁹ turns."""
        most = 10**9 * self._counts_per_turn
        low, high = (self.to_counts(self._line.number(query, ANY_NUMBER)) for query in ("TMN?", "TMX?"))
        return max(low, -most), min(high, most)

    def moving(self) -> bool:
        form = r"(?:0[xX])?([0-9A-Fa-f]{1,8})"
        return bool(int(self._line.ask(ARE_THEY_MOVING, form, "the moving axes, as bits")[1], 16) >> self._bit & 1)

    def searching(self) -> bool:
        """True if the axis moves, or is between two parts of a reference move."""
        return self._line.ask(READY, "[\xb0\xb1]", "the byte B1 (ready) or B0")[0] == "\xb0" or self.moving()

    def counts(self) -> int:
        return self.to_counts(self._line.number("POS?"))

    def on_target(self) -> bool:
        return self._line.flag("ONT?")

    def status(self) -> PiAxisStatus:
        """Read position and state of the axis; `fault` becomes the content of the error register."""
        self._line.read_error()
        homed, servo, counts = self._line.flag("FRF?"), self._line.flag("SVO?"), self.counts()
        error = meaning(self._line.fault) or "no error"
        in_words = f"counts {counts}, referenced {homed:d}, servo {servo:d}, {error}"
        return PiAxisStatus(counts, homed, servo, in_words)

    def limit_switch(self) -> str:
        """Text about the active limit switch; "" if none is active, or if the model has an unknown register."""
        if "C-863" not in self._identity:
            return ""
        bits = int(self._line.ask(REGISTER, r"0[xX]([0-9A-Fa-f]{1,8})", "the status register")[1], 16)
        return {1: "negative limit switch", 4: "positive limit switch", 5: "both limit switches"}.get(bits & 5, "")

    def standing(self, purpose: str) -> None:
        """Raise DeviceRefused for `purpose` while the axis moves; `fault` becomes the content of the error register."""
        if self.moving():
            raise while_it_moves(self._name, purpose, self.counts())
        self._line.read_error()

    def start(self, target: int, speed: Fraction) -> None:
        """Begin a move to `target` counts at `speed` counts/s; the axis must be at rest."""
        self._take_rate("VEL", speed)
        self._begin(command := f"MOV {self._axis} {self.degrees(target)}")
        taken = self._line.number("MOV?")
        if self.to_counts(taken) != target:
            raise self._line.not_followed(command, taken, self.degrees(target))

    def search_reference(self, command: str) -> None:
        """Begin FRF, FNL or FPL; the axis must be at rest."""
        code, has = (31, "TRS?") if command == "FRF" else (32, "LIM?")
        if not self._line.flag(has):
            raise self._refused(f"{command} is not possible: {REFUSALS[code][0]}", advice(code), f"{has} {self._axis}")
        self.disarm()
        self._begin(f"{command} {self._axis}")

    def brake(self) -> str:
        """Send the stop command; returns it."""
        self._line.stop(command := f"HLT {self._axis}")
        return command

    def stop_all(self) -> str:
        """Stop all axes of the controller at once."""
        self._line.stop(STOP_ALL)
        return f"#{STOP_ALL[0]}"

    def arm(self, window: TriggerWindow, active_high: bool) -> None:
        """Set up the trigger line and switch it on; the axis must be at rest."""
        self.disarm()
        self._configure(2, self._axis)
        self._configure(3, "0")
        self._configure(7, f"{active_high:d}")
        self._configure(1, self.degrees(window.step), window.step_tolerance)
        self._configure(8, self.degrees(window.start))
        self._configure(9, self.degrees(window.stop))
        self._switch_trigger(True)

    def disarm(self) -> None:
        self._switch_trigger(False)

    def _begin(self, command: str) -> None:
        self._line.fault, before, self._line.commanded = 0, self._line.commanded, True
        self.last_move = command
        code = self._line.tell(command)
        if code in REFUSALS:
            self._line.commanded = before
        if code == NOT_ALLOWED_TO_MOVE:
            raise self._may_not_move(command)
        self._line.raise_error(command, code)

    def _may_not_move(self, command: str) -> DeviceRefused:
        """The error for code 5, with the one of its two reasons that is true."""
        verb = command.split()[0]
        if not self._line.flag("SVO?"):
            why = (
                "Find what switched the servo off, then close the driver and open it again, which switches the servo on"
            )
            return self._refused(f"{verb} is not possible: the servo is off", why, command)
        if not self._line.flag("FRF?"):
            why = "Start a reference search (start_home) when nothing is in the way of the stage"
            return self._refused(f"{verb} is not possible: the axis has no reference yet", why, command)
        return self._refused(f"{verb} ended with {meaning(5)}", advice(5), command)

    def _configure(self, parameter: int, value: str, tolerance: Fraction = Fraction(1, 2)) -> None:
        """Send one CTO command and read the value back; the reply may have fewer decimals. `tolerance` is in counts."""
        command = f"CTO {self._output} {parameter} {value}"
        self._line.set(command)
        form = r"(\w+)" if parameter == 2 else NUMBER
        query = f"CTO? {self._output} {parameter}"
        reply = self._line.ask(query, rf"{self._output} {parameter} ?= ?{form}", f"{value}, as just set")[1]
        if parameter in (2, 3, 7):
            same = reply == value or (parameter != 2 and Fraction(reply) == int(value))
        else:
            miss = abs(Fraction(reply) - Fraction(value)) * self._counts_per_turn / 360
            same = is_rounding_of(reply, value) and miss < tolerance
        if not same:
            raise self._line.not_followed(command, reply, value)

    def _switch_trigger(self, on: bool) -> None:
        command = f"TRO {self._output} {on:d}"
        self._line.set(command)
        reply = self._line.ask(f"TRO? {self._output}", rf"{self._output} ?= ?([01])", f"{on:d}, as just set")[1]
        if reply != f"{on:d}":
            raise self._line.not_followed(command, reply, f"{on:d}")

    def _compare_counts(self) -> None:
        """Check that our counts are multiples of the controller's, if it reports them (parameters 0xE and 0xF)."""
        numerator, denominator = (self._line.parameter(number) for number in (NUMERATOR, DENOMINATOR))
        if numerator is None or denominator is None or not Fraction(denominator):
            return
        own = Fraction(numerator) / Fraction(denominator) * 360
        if own == 0 or (own / self._counts_per_turn).denominator != 1:
            raise self._refused(
                f"the controller has {float(own):.10g} counts per turn, which is not a multiple of the configured "
                f"{self._counts_per_turn}",
                "Correct counts_per_turn in the configuration, or the controller's parameters 0xE and 0xF",
            )

    def _take_accelerations(self, rate: Fraction) -> None:
        """Set accelerations with ACC and DEC; a controller without these commands has parameters for both."""
        for command, parameter in (("ACC", ACCELERATION), ("DEC", DECELERATION)):
            before = self._line.parameter(parameter)
            if before is not None:
                self.found.values[f"SPA {parameter}"] = before
            try:
                self._take_rate(command, rate)
            except DeviceRefused:
                if self._line.fault != UNKNOWN_COMMAND:
                    raise
                text = self.degrees(rate)
                self._line.set(instead := f"SPA {self._axis} {parameter} {text}")
                reply = self._line.parameter(parameter)
                if reply is None or not _nearly(text, reply):
                    raise self._line.not_followed(instead, reply or "", text) from None

    def _take_rate(self, command: str, rate: Fraction) -> None:
        """The value of VEL, ACC or DEC in counts."""
        text = self.degrees(rate)
        self._line.set(f"{command} {self._axis} {text}")
        reply = self._line.number(f"{command}?")
        if not _nearly(text, reply):
            raise self._line.not_followed(f"{command} {self._axis} {text}", reply, text)

    def restore(self) -> None:
        """Restore the settings that moves and opening have changed; not during a move, because they would affect it."""
        if self.found.values and not self.moving():
            self._line.read_error()  # the code belongs to an earlier move or stop and not to the settings
            self.found.restore(lambda setting, value: self._line.set(_setting(setting, self._axis, value)))

    def _refused(self, problem: str, advice: str, request: str = "") -> DeviceRefused:
        return DeviceRefused(self._name, problem, request=request, advice=advice, state="Nothing has moved")


def _setting(name: str, axis: str, value: str) -> str:
    """The command that sets VEL or a parameter."""
    command, _, parameter = name.partition(" ")
    return f"{command} {axis} {f'{parameter} ' if parameter else ''}{value}"


def _nearly(sent: str, reply: str) -> bool:
    return abs(Fraction(sent) - Fraction(reply)) <= RATE_AGREES * abs(Fraction(sent))
