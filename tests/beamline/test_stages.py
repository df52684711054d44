"""A stage from its configuration: its limits, its transcript, and the outputs that it has for a shutter."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from beamline import devices
from beamline.errors import ConfigError
from beamline.stages import output_of
from drivers.errors import DeviceRefused
from tests.beamline.ball_scan import STAGES, small


@pytest.mark.parametrize("kind", ["pi_gcs", "zaber"])
def test_a_shutter_never_sits_on_the_trigger_output(kind: str) -> None:
    settings = small(f"devices.stage={STAGES[kind]}")
    taken = {"pi_gcs": 2, "zaber": 3}[kind]
    with devices.connect(settings) as bench, pytest.raises(DeviceRefused, match=f"output {taken} gives the trigger"):
        output_of(settings.devices.stage, bench.devices.stage, taken)
    pm16c = small()
    with devices.connect(pm16c) as bench, pytest.raises(ConfigError, match="has no digital output"):
        output_of(pm16c.devices.stage, bench.devices.stage, 1)


def test_a_stage_keeps_a_transcript_where_it_is_asked_to(tmp_path: Path) -> None:
    file = tmp_path / "stage.txt"
    with devices.connect(small(f"devices.stage.transcript={file}")) as bench:
        bench.devices.stage.position()
    assert b"PS?0" in file.read_bytes()


def test_limits_hold() -> None:
    with devices.connect(small("devices.stage.high_deg=90")) as bench, pytest.raises(DeviceRefused):
        bench.devices.stage.start_move(math.pi, 0.1)
