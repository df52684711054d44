"""A stage from its configuration: its limits, its transcript, and its outputs for a shutter."""

import math
from contextlib import nullcontext
from pathlib import Path

import pytest

from beamline.instrument import connect as devices
from beamline.scan.dry_run import dry_run
from drivers.base.errors import DeviceRefused
from tests.beamline.ball_scan import COMMON, STAGES, small
from tests.messages import refused

pytestmark = pytest.mark.usefixtures("simulated_zaber")


@pytest.mark.parametrize("kind", ["pi_gcs", "zaber"])
def test_a_shutter_never_sits_on_the_trigger_output(kind: str) -> None:
    settings = small(f"devices.stage={STAGES[kind]}")
    taken = {"pi_gcs": 2, "zaber": 3}[kind]
    with (
        devices.connect(settings) as instrument,
        pytest.raises(DeviceRefused, match=f"{taken} gives"),
    ):
        instrument.devices.stage.digital_output(taken)
    pm16c = small()
    with devices.connect(pm16c) as instrument, refused(DeviceRefused):
        instrument.devices.stage.digital_output(1)


def test_a_stage_keeps_a_transcript_where_it_is_asked_to(tmp_path: Path) -> None:
    file = tmp_path / "stage.txt"
    with devices.connect(small(f"devices.stage.transcript={file}")) as instrument:
        instrument.devices.stage.position()
    assert b"PS?0" in file.read_bytes()


CLOSE = {
    "pm16c": ("kind: pm16c, port: 'sim://pm16c', pulse_width_s: 0.001", {3051}),
    "pm16c, widths by train": ("kind: pm16c, port: 'sim://pm16c'", set[int]()),
    "pi_gcs": ("kind: pi_gcs, port: 'sim://pi_gcs', firmware_pulse_s: 0.001", {3051}),
    "zaber": ("kind: zaber, port: 'sim://zaber'", {3051}),
    "zaber, slow": ("kind: zaber, port: 'sim://zaber', shortest_s: 0.00205", {2951, 3000, 3051}),
    "zaber, toggled": ("kind: zaber, port: 'sim://zaber', toggle: true", {2951, 3051}),
}


@pytest.mark.parametrize(("stage", "rejected"), CLOSE.values(), ids=CLOSE)
def test_a_dry_run_refuses_the_pulses_that_the_stage_would_refuse(stage: str, rejected: set[int]) -> None:
    """2951, 3000 and 3051 views over half a turn are 61, 60 and 59 counts apart; at full speed 60 take 2 ms."""
    for views, counts in ((2951, 61), (3000, 60), (3051, 59)):
        settings = small(f"devices.stage={{{stage}, {COMMON}}}", f"scan.angles={{scheme: fixed, views: {views}}}")
        worked = dry_run(settings)
        assert worked.timeline.step_counts == counts
        assert any("trigger output" in said for said in worked.timeline.violations) == (views in rejected)
        with devices.connect(settings) as instrument:
            assert instrument.devices.stage.limits == worked.stage
            instrument.devices.stage.start_move(math.radians(-2), math.radians(10))
            instrument.devices.stage.wait(10.0)
            expected = refused(DeviceRefused) if views in rejected else nullcontext()
            with expected:
                instrument.devices.stage.arm(worked.timeline.views.trains[0])


def test_limits_hold() -> None:
    with devices.connect(small("devices.stage.high_deg=90")) as instrument, pytest.raises(DeviceRefused):
        instrument.devices.stage.start_move(math.pi, 0.1)
