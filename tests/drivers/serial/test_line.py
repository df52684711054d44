"""Serial line: framing, timeouts and resynchronisation on a disturbed wire."""

from __future__ import annotations

import itertools
import threading
import time

import pytest
import serial
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from drivers.base.clock import SystemClock
from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.serial.line import LineRules, Probe, SerialLine, serial_ports
from drivers.serial.line_reader import RECENT_LINES
from simulators.devices.clock import VirtualClock
from simulators.wires.wire import register
from tests.messages import refused


def listed(device: str, **facts: object) -> ListPortInfo:
    port = ListPortInfo(device)
    for name, value in facts.items():
        setattr(port, name, value)
    return port


def test_ports_and_what_they_say(monkeypatch: pytest.MonkeyPatch) -> None:
    adapter = listed("/dev/ttyUSB0", vid=0x0403, pid=0x6001, serial_number="FT1234", description="FT232R USB UART")
    monkeypatch.setattr(list_ports, "comports", lambda: [adapter, listed("/dev/ttyS0")])
    plain, usb = serial_ports().split("; ")
    assert plain == "/dev/ttyS0 (n/a, n/a)" and usb.startswith("/dev/ttyUSB0 (FT232R USB UART, ")


NAMES = (f"line-test-{number}" for number in itertools.count())
NUMBER = r"-?\d+"


class Echo:
    """A device that answers "N?n" with n and "ID?" with "ECHO"; a test says what it sends instead, and when.

    `spoil` maps the number of a request (from 0) to pieces (s after the request, bytes).
    """

    def __init__(self, spoil: dict[int, list[tuple[float, bytes]]] | None = None) -> None:
        self.clock = VirtualClock(start=0.0)
        self.heard: list[str] = []
        self._spoil = spoil or {}
        self._coming: list[tuple[float, bytes]] = []

    def receive(self, data: bytes) -> None:
        for line in data.decode().split("\r\n")[:-1]:
            usual = {"ID?": "ECHO"}.get(line, line.removeprefix("N?")) if "?" in line else None
            pieces = [(0.0, f"{usual}\r\n".encode())] if usual is not None else []
            for delay, piece in self._spoil.get(len(self.heard), pieces):
                self._coming.append((self.clock.now() + delay, piece))
            self.heard.append(line)

    def transmit(self) -> bytes:
        due = [piece for time, piece in self._coming if time <= self.clock.now()]
        self._coming = [(time, piece) for time, piece in self._coming if time > self.clock.now()]
        return b"".join(due)


def connect(echo: Echo, timeout: float = 1.0) -> SerialLine:
    return SerialLine(
        register(next(NAMES), echo),
        LineRules(Probe("ID?", "ECHO"), unsolicited="STOP[0-9A-F]"),
        echo.clock,
        device="echo",
        timeout=timeout,
        baudrate=9600,
    )


def ask(line: SerialLine, n: int) -> int:
    return int(line.query(f"N?{n}", NUMBER, "a number", "Nothing has moved")[0])


# in step


def test_notes_that_nobody_asked_for_are_passed_over() -> None:
    line = connect(Echo({0: [(0.0, b"STOPB\r\n7"), (0.1, b"7\r\nSTOP0\r\n")]}))
    assert ask(line, 0) == 77
    assert ask(line, 1) == 1


class Crossing(Echo):
    """Lets another thread go on between a request and its reply."""

    def receive(self, data: bytes) -> None:
        super().receive(data)
        time.sleep(0)


def test_threads_do_not_take_each_others_replies() -> None:
    line = connect(Crossing())
    wrong: list[int] = []

    def many(first: int) -> None:
        wrong.extend(n for n in range(first, first + 200) if ask(line, n) != n)

    threads = [threading.Thread(target=many, args=(1000 * k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


# out of step


def test_silence_is_a_timeout_that_says_all_there_is_to_know() -> None:
    line = connect(Echo({0: []}), timeout=0.5)
    with pytest.raises(DeviceTimeout) as error:
        ask(line, 3)
    assert (error.value.device, error.value.request, error.value.expected) == ("echo", "N?3", "a number")
    assert "within 0.5 s" in str(error.value)
    assert "Nothing has moved" in str(error.value)


def test_the_timeout_is_for_the_whole_reply_however_it_trickles() -> None:
    echo = Echo({0: [(0.3 * k, b"1") for k in range(100)]})
    with refused(DeviceTimeout):
        ask(connect(echo, timeout=1.0), 3)
    assert echo.clock.now() == pytest.approx(1.0, abs=0.1)


def test_a_reply_that_is_whole_at_the_very_deadline_is_taken_or_not_but_never_taken_for_another() -> None:
    """To the last millisecond it is the reply; beyond, a late one. From the deadline itself either is right."""
    for late in (-0.06, -0.002, -0.001, 0.0, 0.001, 0.002, 0.06):
        echo = Echo({0: [(0.0, b"1"), (0.5, b"1"), (1.0 + late, b"1\r\n")]})
        line = connect(echo, timeout=1.0)
        try:
            assert ask(line, 111) == 111
            assert late < 0.06
        except DeviceTimeout:
            assert late >= 0.0
        assert [ask(line, n) for n in (222, 333)] == [222, 333]


def test_a_late_answer_to_an_earlier_probe_is_not_left_behind() -> None:
    """The probe itself timed out once; its late answer ends the second probe, whose own must not meet a request."""
    echo = Echo({0: [], 1: [(1.15, b"ECHO\r\n")], 2: [(0.08, b"ECHO\r\n")]})
    line = connect(echo)
    for _ in range(2):
        with pytest.raises(DeviceTimeout):
            ask(line, 1)
    assert ask(line, 2) == 2
    echo.clock.sleep(1.0)
    assert ask(line, 3) == 3
    assert echo.heard == ["N?1", "ID?", "ID?", "N?2", "N?3"]


@pytest.mark.parametrize("reply", [b"\xff\x80garbage\r\n", b"\r\n", b"1 2\r\n", b"12\n\r\n", b"ECHO\r\n"])
def test_a_reply_of_another_form_is_named_and_not_believed(reply: bytes) -> None:
    echo = Echo({0: [(0.0, reply)]})
    line = connect(echo)
    with refused(DeviceError) as error:
        ask(line, 1)
    assert not isinstance(error.value, DeviceTimeout)
    assert ask(line, 2) == 2
    assert echo.heard == ["N?1", "ID?", "N?2"]


@pytest.mark.parametrize("reply", [b"\xff\xfb\x0112\r\n", b"1\x002\r\n", b"\xb112\r\n", b"\x7f\r\n"])
def test_bytes_that_are_no_text_are_refused_in_a_reply_of_any_form(reply: bytes) -> None:
    line = connect(Echo({0: [(0.0, reply)]}))
    with refused(DeviceError):
        line.query("N?1", ".*", "anything")
    assert ask(line, 2) == 2


def test_a_control_byte_may_be_answered_by_a_byte() -> None:
    class Ready(Echo):
        def receive(self, data: bytes) -> None:
            self._coming.append((self.clock.now(), b"\xb1\r\n"))

    assert connect(Ready()).query(b"\x07", "[\xb0\xb1]", "ready or not")[0] == "\xb1"


def test_a_device_that_has_never_answered_may_be_set_otherwise() -> None:
    rules = LineRules(Probe("ID?", "ECHO"), unanswered=". It may be set to another protocol")
    echo = Echo({0: [], 3: []})
    line = SerialLine(register(next(NAMES), echo), rules, echo.clock, device="echo", timeout=0.5, baudrate=9600)
    with refused(DeviceTimeout):
        ask(line, 1)
    assert ask(line, 2) == 2
    with refused(DeviceTimeout) as later:
        ask(line, 3)
    assert "another protocol" not in str(later.value)


def test_a_device_that_never_stops_sending_is_named() -> None:
    line = connect(Echo({0: [(0.01 * k, b"x\r\n") for k in range(400)]}))
    with pytest.raises(DeviceError):
        ask(line, 1)
    with refused(DeviceTimeout):
        ask(line, 2)


def test_a_dead_device_is_named_again_at_each_request_until_it_answers() -> None:
    line = connect(Echo({0: [], 1: [], 2: []}))
    with refused(DeviceTimeout):
        ask(line, 1)
    for _ in range(2):
        with refused(DeviceTimeout):
            ask(line, 1)
    assert ask(line, 4) == 4


def test_a_command_without_reply_goes_out_at_once_even_out_of_step() -> None:
    echo = Echo({0: []})
    line = connect(echo)
    with pytest.raises(DeviceTimeout):
        ask(line, 1)
    before = echo.clock.now()
    line.send("STOP NOW")
    assert (echo.heard[-1], echo.clock.now()) == ("STOP NOW", before)


# what errors tell of the wire


def test_an_error_tells_what_last_went_over_the_wire_and_when() -> None:
    echo = Echo({1: [(0.25, b"4")]})
    line = connect(echo)
    ask(line, 7)
    echo.clock.sleep(2.0)
    with pytest.raises(DeviceTimeout) as error:
        ask(line, 42)
    *before, last = error.value.wire.split(", ")
    assert [entry.split(" (")[0] for entry in (*before, last)] == ["> N?7", "< 7", "> N?42"]
    ages = [float(entry.split("(")[1].split()[0]) for entry in (*before, last)]
    assert ages == pytest.approx([3.0, 3.0, 1.0], abs=0.15)
    assert str(error.value).endswith(f"On the wire: {error.value.wire}.")


def test_a_device_that_stays_silent_is_told_with_the_request_that_it_first_missed() -> None:
    line = connect(Echo({0: [], 1: []}))
    with pytest.raises(DeviceTimeout):
        ask(line, 1)
    with pytest.raises(DeviceTimeout) as error:
        ask(line, 2)
    lines = [entry.split(" (")[0] for entry in error.value.wire.split(", ")]
    assert lines == ["> N?1", "! out of step: probing", "> ID?"]


def test_only_the_last_lines_are_told_and_long_ones_are_cut() -> None:
    line = connect(Echo({9: [(0.0, b"x" * 900 + b"\r\n")]}))
    for n in range(9):
        ask(line, n)
    with pytest.raises(DeviceError, match="have the expected form") as error:
        ask(line, 9)
    lines = error.value.wire.split(", ")
    assert len(lines) == RECENT_LINES
    assert lines[0].startswith("> N?7 ")
    assert lines[-1].startswith("< " + "x" * 40 + "... (")
    assert len(error.value.wire) < 300


# the port


@pytest.mark.parametrize("url", ["sim://nobody", "nonsense://x", "/no/such/port", "socket://127.0.0.1:1"])
def test_a_port_that_does_not_open_is_named(url: str) -> None:
    with pytest.raises(DeviceError, match="does not open") as error:
        SerialLine(url, LineRules(Probe("ID?", "")), SystemClock(), device="d", timeout=0.1, baudrate=9600)
    assert url in str(error.value)
    assert "Nothing was sent" in str(error.value)


def test_a_port_that_vanishes_is_named_on_reading_and_on_writing() -> None:
    class Unplugged(Echo):
        gone = False

        def receive(self, data: bytes) -> None:
            if self.gone:
                raise serial.SerialException("device disconnected")
            super().receive(data)
            self.gone = True

        def transmit(self) -> bytes:
            if self.gone:
                raise serial.SerialException("device disconnected")
            return b""

    line = connect(Unplugged())
    for _ in range(2):
        with refused(DeviceError):
            ask(line, 1)
    with refused(DeviceError):
        line.send("GO")


def test_a_port_that_takes_no_bytes_is_a_timeout() -> None:
    class Stuck(Echo):
        def receive(self, data: bytes) -> None:
            raise serial.SerialTimeoutException("write timeout")

    with refused(DeviceTimeout):
        connect(Stuck()).send("GO")
