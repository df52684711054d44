"""A beam monitor of a configuration is connected with the instrument, or its simulated counterpart is."""

from pathlib import Path

import pytest

from beamline.instrument import connect as devices
from drivers.base.errors import DeviceError
from tests.beamline.ran import small


def test_a_beam_monitor_is_part_of_the_bench(tmp_path: Path) -> None:
    with devices.connect(small()) as instrument:
        assert instrument.beam_monitor is None
    transcript = tmp_path / "electrometer.txt"
    chosen = f"{{kind: electrometer, port: 'sim://electrometer', scale: 1e9, unit: nA, transcript: '{transcript}'}}"
    with devices.connect(small(f"devices.beam_monitor={chosen}")) as instrument:
        assert instrument.beam_monitor is not None
        reading = instrument.beam_monitor.reading()
        assert (reading.value, reading.unit) == (pytest.approx(1.0), "nA")
        assert abs(reading.time - instrument.clock.now()) < 1
    with pytest.raises(DeviceError):
        instrument.beam_monitor.reading()
    assert b"READ?" in transcript.read_bytes()
    page = tmp_path / "ring.txt"
    page.write_text("I = 99.5 mA", encoding="utf-8")
    chosen = f"{{kind: ring_current, url: '{page.as_uri()}', pattern: 'I = ([0-9.]+) mA'}}"
    with devices.connect(small(f"devices.beam_monitor={chosen}")) as instrument:
        assert instrument.beam_monitor is not None
        assert instrument.beam_monitor.reading().value == 99.5
