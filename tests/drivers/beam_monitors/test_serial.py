"""The electrometer over its simulated wire: values, faults, and a line that a probe brings into step again."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import pytest

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import BeamMonitor
from drivers.beam_monitors.reading import TextBeamMonitor
from drivers.beam_monitors.serial import PATTERN, ElectrometerQuery, SerialSource
from simulators.devices.clock import VirtualClock
from simulators.wires.electrometer import OVER_RANGE, ElectrometerWire
from simulators.wires.serial_url import register

NAMES = (f"electrometer-{number}" for number in itertools.count())


def over(wire: ElectrometerWire, transcript: Path | None = None, **query: Any) -> BeamMonitor:
    url, asked = register(next(NAMES), wire), ElectrometerQuery(**query)
    source = SerialSource(url, wire.clock, asked, timeout=0.5, transcript=transcript)
    return TextBeamMonitor(source, wire.clock, pattern=PATTERN, unit="A")


def test_the_current_of_the_moment() -> None:
    clock = VirtualClock(100.0)
    monitor = over(ElectrometerWire(clock, lambda time: 1e-9 * (time - 99)))
    first = monitor.reading()
    clock.sleep(10.0)
    second = monitor.reading()
    for reading in (first, second):
        assert reading.unit == "A"
        # 20 ms of a reading, and the millisecond in which the port looks for it
        assert reading.value == pytest.approx(1e-9 * (reading.time - 99), abs=2.1e-12)
    assert second.time - first.time == pytest.approx(10.02, abs=0.01)
    monitor.close()
    with pytest.raises(DeviceError, match="it was closed"):
        monitor.reading()


@pytest.mark.parametrize("end", [b"\r\n", b"\r", b"\n"])
def test_line_ends_and_setup(end: bytes, tmp_path: Path) -> None:
    clock = VirtualClock()
    wire = ElectrometerWire(clock, lambda time: -2.5e-12, end=end)
    setup = ("*RST", "SYST:ZCH OFF")
    monitor = over(wire, line_end=end, setup=setup, transcript=tmp_path / "line.txt")
    assert monitor.reading().value == -2.5e-12
    monitor.close()
    assert wire.heard == [*setup, "READ?"]
    assert b"SYST:ZCH OFF" in (tmp_path / "line.txt").read_bytes()


def test_silence_is_a_timeout_and_then_it_goes_on() -> None:
    monitor = over(ElectrometerWire(VirtualClock(), silent={1}))
    monitor.reading()
    with pytest.raises(DeviceTimeout, match=r"no whole reply within 0\.5 s.*Asked 'READ\?'"):
        monitor.reading()
    assert monitor.reading().value == 1e-9


@pytest.mark.parametrize("text", [b"", b"\xfe\x00\x9c", b"A,+1.0", b"NAN,+1.0,+0.0", b"BUSY"])
def test_garbage_is_no_reading_and_then_it_goes_on(text: bytes) -> None:
    monitor = over(ElectrometerWire(VirtualClock(), spoilt={0: text}))
    with pytest.raises(DeviceError, match="does not have the form"):
        monitor.reading()
    assert monitor.reading().value == 1e-9


def test_a_late_answer_is_not_taken_for_the_next_one() -> None:
    clock = VirtualClock(0.0)
    wire = ElectrometerWire(clock, lambda time: math.floor(time) + 1.0, latency=0.8)
    monitor = over(wire)
    with pytest.raises(DeviceTimeout):
        monitor.reading()
    clock.sleep(5.0)  # by now the late answer waits on the line
    wire._latency = 0.01
    reading = monitor.reading()
    assert reading.value == math.floor(reading.time) + 1.0 > 5.0


def test_over_range() -> None:
    with pytest.raises(DeviceError, match="over range"):
        over(ElectrometerWire(VirtualClock(), lambda time: OVER_RANGE)).reading()


def test_an_empty_query() -> None:
    with pytest.raises(DeviceRefused, match="query is empty"):
        over(ElectrometerWire(VirtualClock()), query="")


def test_no_port() -> None:
    with pytest.raises(DeviceError, match="does not open"):
        SerialSource("COM_NONE", VirtualClock())
