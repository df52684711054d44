"""Serial line with other framings: line endings, multi-line replies, checksums, control bytes, transcripts."""

from __future__ import annotations

import ast
import itertools
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.serial.line import LineRules, Probe, SerialLine
from drivers.serial.line_reader import LONGEST_REPLY, Framing
from simulators.devices.clock import VirtualClock
from simulators.wires.wire import register
from tests.messages import refused

NAMES = (f"framing-test-{number}" for number in itertools.count())
GCS = Framing(command_end=b"\n", line_end=b"\n", continued=" ")


class Script:
    """A device that answers each write with the next of `replies`, and "ID?" with "me" whenever they are used up."""

    def __init__(self, *replies: bytes, end: bytes = b"\n") -> None:
        self.clock = VirtualClock(start=0.0)
        self.heard: list[bytes] = []
        self.sent: list[bytes] = []
        self.waiting = b""
        self.replies, self._end = list(replies), end

    def receive(self, data: bytes) -> None:
        self.heard.append(data)
        if self.replies:
            self.waiting += self.replies.pop(0)
        elif data.startswith(b"ID?"):
            self.waiting += b"me" + self._end

    def transmit(self) -> bytes:
        data, self.waiting = self.waiting, b""
        if data:
            self.sent.append(data)
        return data


def connect(wire: Any, **settings: Any) -> SerialLine:
    of_line = {name: settings.pop(name) for name in ("timeout", "transcript") if name in settings}
    rules = LineRules(**({"framing": GCS, "probe": Probe("ID?", "me"), **settings}))
    usual: dict[str, Any] = {"timeout": 1.0, "baudrate": 9600, "device": "script"}
    return SerialLine(register(next(NAMES), wire), rules, wire.clock, **(usual | of_line))


# ends of lines


@pytest.mark.parametrize(("command_end", "line_end"), [(b"\n", b"\r\n"), (b"\r", b"\n"), (b"", b";")])
def test_commands_and_lines_end_as_they_are_told_to(command_end: bytes, line_end: bytes) -> None:
    wire = Script(b"", b"1" + line_end + b"2" + line_end)
    line = connect(wire, framing=Framing(command_end, line_end))
    line.send("GO")
    assert line.query("A?", r"\d", "a digit")[0] == "1"
    assert wire.heard == [b"GO" + command_end, b"A?" + command_end]


@given(st.lists(st.text("abc=1", max_size=5), min_size=1, max_size=6), st.integers(1, 5))
def test_replies_of_any_number_of_lines_come_whole_however_they_are_cut(lines: list[str], piece: int) -> None:
    class Slow(Script):
        def transmit(self) -> bytes:
            data, self.waiting = self.waiting[:piece], self.waiting[piece:]
            return data

    line = connect(Slow(" \n".join(lines).encode() + b"\n", b"next\n"))
    assert line.query("A?", r"(?s).*", "lines")[0] == "\n".join(lines)
    assert line.query("B?", r"next", "the next reply")[0] == "next"


def test_without_such_a_text_every_line_is_a_reply() -> None:
    line = connect(Script(b"1 \n"), framing=Framing(b"\n", b"\n"))
    assert line.query("A?", r".*", "anything")[0] == "1 "


def test_a_reply_whose_last_line_never_comes_is_a_timeout() -> None:
    line = connect(Script(b"1=2 \n2=3 \n"))
    with refused(DeviceTimeout):
        line.query("A?", r"(?s).*", "lines")
    assert line.query("ID?", "me", "me")[0] == "me"


def test_a_reply_of_endless_lines_is_given_up() -> None:
    wire = Script(b"123456789 \n" * (LONGEST_REPLY // 5))
    line = connect(wire, timeout=100.0)
    with refused(DeviceTimeout):
        line.query("A?", r"(?s).*", "lines")
    assert wire.clock.now() < 1.0
    assert line.query("ID?", "me", "me")[0] == "me"


def test_notes_between_the_lines_of_a_reply_are_passed_over() -> None:
    line = connect(Script(b"1 \n!note\n2\n"), unsolicited="!.*")
    assert line.query("A?", r"(?s).*", "lines")[0] == "1\n2"


# what came before


def test_a_line_that_came_before_the_request_is_not_its_reply() -> None:
    wire = Script()
    line = connect(wire)
    wire.waiting = b"7\n8\n"
    wire.receive(b"")
    wire.replies = [b"9\n"]
    assert line.query("A?", r"\d", "a digit")[0] == "9"
    assert wire.heard == [b"", b"A?\n"]


def test_the_beginning_of_a_note_that_came_before_the_request_is_kept_for_its_rest() -> None:
    wire = Script(b"te\n9\n")
    line = connect(wire, unsolicited="!note")
    wire.waiting = b"!no"
    assert line.query("A?", r"\d", "a digit")[0] == "9"


# checksums


def even(line: str) -> str:
    return "" if len(line) % 2 == 0 else f"{len(line)} characters are not even"


def test_a_damaged_reply_is_named_and_not_believed_and_the_line_finds_its_step() -> None:
    wire = Script(b"123\n", b"abc\nme\n")
    line = connect(wire, check=even)
    with refused(DeviceError) as error:
        line.query("A?", r"\d+", "digits")
    assert (error.value.reply, isinstance(error.value, DeviceTimeout)) == ("123", False)
    assert line.query("ID?", "me", "me")[0] == "me"
    assert wire.heard == [b"A?\n", b"ID?\n", b"ID?\n"]


def test_every_line_of_a_reply_is_checked_and_so_are_notes() -> None:
    for reply in (b"12 \n345\n", b"!no\n12\n"):
        line = connect(Script(reply), unsolicited="!.*", check=even)
        with refused(DeviceError):
            line.query("A?", r"(?s).*", "anything")


# control bytes


def test_control_bytes_go_out_bare_and_may_be_answered() -> None:
    wire = Script(b"", b"0\n")
    line = connect(wire)
    line.send(b"\x18")
    assert line.query(b"\x05", "[0-9A-F]", "a motion status")[0] == "0"
    assert wire.heard == [b"\x18", b"\x05"]


def test_an_error_about_a_control_byte_can_be_read() -> None:
    line = connect(Script(b""))
    with pytest.raises(DeviceTimeout) as error:
        line.query(b"\x05", "[0-9A-F]", "a motion status")
    assert r"Asked '\x05'" in str(error.value)
    assert r"> \x05 (" in error.value.wire
    assert str(error.value).isprintable()


# the transcript


def read_transcript(path: Path) -> list[tuple[float, str, bytes]]:
    lines = [line.split(" ", 2) for line in path.read_text("ascii").splitlines()]
    return [(float(time), mark, ast.literal_eval(data)) for time, mark, data in lines]


@given(st.lists(st.binary(min_size=1, max_size=20), max_size=5))
def test_the_transcript_has_every_byte_and_when_it_went(
    tmp_path_factory: pytest.TempPathFactory, replies: list[bytes]
) -> None:
    path = tmp_path_factory.mktemp("transcript") / "line.txt"
    wire = Script(*replies)
    line = connect(wire, transcript=path)
    for k in range(len(replies)):
        wire.clock.sleep(3.0)
        try:
            line.query(f"N?{k}", r"\d", "a digit")
        except DeviceError:
            line.send(b"\x18")
    line.close()
    entries = read_transcript(path)
    assert b"".join(data for _, mark, data in entries if mark == ">") == b"".join(wire.heard)
    assert b"".join(data for _, mark, data in entries if mark == "<") == b"".join(wire.sent)
    times = [time for time, _, _ in entries]
    assert times == sorted(times)
    assert all(3.0 <= time <= wire.clock.now() + 1e-6 for time in times)


def test_a_transcript_is_added_to_and_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "line.txt"
    for word in ("ONE", "TWO"):
        line = connect(Script(), transcript=path)
        line.send(word)
        line.close()
    assert [data for _, _, data in read_transcript(path)] == [b"ONE\n", b"TWO\n"]


def test_a_transcript_that_cannot_be_written_is_refused_before_anything_is_sent(tmp_path: Path) -> None:
    wire = Script()
    with pytest.raises(DeviceError, match=r"transcript.*Nothing was sent"):
        connect(wire, transcript=tmp_path / "no such folder" / "line.txt")
    assert wire.heard == []
