"""Fuzzing the serial line: calls always end in time, with a DeviceError or not, and resynchronise."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from drivers.base.errors import DeviceError
from drivers.serial.line import QUIET, LineRules, Probe, SerialLine
from drivers.serial.line_reader import Framing
from simulators.devices.clock import VirtualClock
from simulators.wires.wire import register
from tests.drivers.fuzz import FuzzedWire, Pieces, allowed, plans

NAMES = (f"fuzz-line-{number}" for number in itertools.count())
TIMEOUT = 0.2
# find quiet, probe, find quiet, ask; each may end late by one look that waits for quiet
LONGEST = 4 * max(TIMEOUT, 10 * QUIET) + 6 * QUIET
FRAMINGS = (Framing(), Framing(b"\n", b"\n", " "), Framing(b"\r", b"\n"), Framing(b"\n", b"\r\n", "+"))
SAMPLES = [b"12\r\n", b"7\n", b"1=2 \n2=3\n", b"7+\r\n8\r\n", b"me\r\n", b"me\n", b"!note\r\n", b"12:AB\n"]
FORMS = (r"\d+", r".*", r"(?s).*", r"N\d+", r"\d=\d(\n\d=\d)*")


class Numbered:
    """Answers "A?n" with "Nn", "ID?" with "me" and a control byte with its number; nothing else."""

    def __init__(self, framing: Framing) -> None:
        self.clock = VirtualClock(start=0.0)
        self._framing = framing
        self._in, self._out = b"", b""

    def receive(self, data: bytes) -> None:
        if data == b"\x05":
            self._say(b"N5")
            return
        *lines, self._in = (self._in + data).split(self._framing.command_end)
        for line in lines:
            if line == b"ID?":
                self._say(b"me")
            elif line.startswith(b"A?"):
                self._say(b"N" + line[2:])

    def transmit(self) -> bytes:
        data, self._out = self._out, b""
        return data

    def _say(self, text: bytes) -> None:
        self._out += text + self._framing.line_end


def no_x(line: str) -> str:
    return "there is an x" if "x" in line else ""


@given(plans(SAMPLES), st.sampled_from(FRAMINGS), st.booleans(), st.lists(st.integers(0, 9), min_size=1, max_size=12))
def test_fuzz_every_call_ends_in_time_and_the_line_finds_its_step_again(
    plan: list[Pieces | None], framing: Framing, checked: bool, calls: list[int]
) -> None:
    wire = FuzzedWire(Numbered(framing), plan)
    line = SerialLine(
        register(next(NAMES), wire),
        LineRules(Probe("ID?", "me"), unsolicited="!.*", framing=framing, check=no_x if checked else lambda line: ""),
        wire.clock,
        device="fuzzed",
        timeout=TIMEOUT,
        baudrate=9600,
    )
    for number, call in enumerate(calls):
        if call < len(FORMS):
            form = FORMS[call]
            found = allowed(lambda: line.query(f"A?{number}", form, "a reply", "Nothing moved"), wire.clock, LONGEST)  # noqa: B023
            assert isinstance(found, DeviceError) or found.re.pattern == form
        elif call == 6:
            allowed(lambda: line.query(b"\x05", r"N5", "a reply"), wire.clock, LONGEST)
        elif call == 7:
            line.send("GO")
        elif call == 8:
            line.send(b"\x18" + framing.command_end)
        else:
            wire.clock.sleep(1.0)
    wire.end()
    wire.clock.sleep(10.0)
    # One request may meet what had come before and one more its remains; the third is answered.
    answers = [allowed(lambda: line.query(f"A?{k}", r"N\d+", "a reply"), wire.clock, LONGEST) for k in (101, 102, 103)]  # noqa: B023
    assert not isinstance(answers[2], DeviceError)
    assert [answer[0] for answer in answers if not isinstance(answer, DeviceError)][-1] == "N103"
    assert isinstance(answers[1], DeviceError) or answers[1][0] == "N102"
    line.close()
