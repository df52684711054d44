"""Align: the axis of a simulated scene, its correction in mm, and views that show none."""

from __future__ import annotations

import math
from typing import Any

import pytest

from beamline.config.load import Config
from beamline.core.errors import QualityError
from beamline.core.stop import ScanStopped, StopRequest
from beamline.features.tuning.align import Alignment, align
from beamline.instrument.connect import connect
from tests.beamline.acquired import assert_safe
from tests.beamline.ball_scan import shipped, with_scene
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import small

ROI = "devices.camera.roi=[1080, 1968, 144, 160]"


def _scene(offset: float) -> Config:
    """The battery with its axis `offset` sensor pixels right of the middle."""
    settings = shipped("simulated", "simulation.clock=virtual", ROI)
    scene: dict[str, Any] = {
        "phantom": {"kind": "battery", "seed": 3, "field_of_view": [0.6, 0.5], "n_particles": 150},
        "beam": {"photons_per_s": 2e5},
        "axis_offset_px": offset,
        "effects": ["photon_noise", "read_noise"],
    }
    return with_scene(settings, scene)


def _aligned(settings: Config, angle: float | None = None) -> Alignment:
    with connect(settings) as instrument:
        found = align(settings, instrument, StopRequest(), lambda event: None, angle)
        assert not instrument.devices.shutter.is_open()
        assert instrument.devices.stage.position() == 0
        return found


@pytest.mark.parametrize("offset", [-4.0, 6.3])
def test_the_axis_of_the_scene_is_found_with_its_correction(offset: float) -> None:
    found = _aligned(_scene(offset))
    assert found.offset == pytest.approx(offset, abs=0.2)
    assert found.axis_col == pytest.approx(79.5 + offset, abs=0.2)
    assert found.offset_mm == pytest.approx(offset * 4.6e-3, abs=1e-3)
    assert abs(found.lean) < 0.5 and found.detail > 0
    axis, tilt, detail = found.lines()
    assert ("right of the middle" in axis) is (offset > 0)
    assert f"move the axis {abs(found.offset_mm):.4g} mm towards {'lower' if offset > 0 else 'higher'} columns" in axis
    assert f"optics.axis_col={found.axis_col:.2f}" in axis
    assert "no correction" in tilt and "px over which the view" in detail


def test_an_axis_that_leans_is_turned_back_by_what_is_said() -> None:
    leans = Alignment(79.5, 0.0, 0.0, math.radians(0.5), math.radians(0.05), 3.0, 0.0, 144)
    axis, tilt, _ = leans.lines()
    assert "move" not in axis
    assert "1.25 px from first to last row; turn the axis 0.500° clockwise" in tilt
    unknown = Alignment(79.5, 0.0, 0.0, math.nan, math.nan, math.nan, 0.0, 144)
    assert "not known" in unknown.lines()[1] and "not known" in unknown.lines()[2]


def test_the_second_view_stays_within_the_limits() -> None:
    assert _aligned(_scene(1.0), math.radians(250)).offset == pytest.approx(1.0, abs=0.2)


def test_views_without_contrast_are_refused_and_the_instrument_is_safe() -> None:
    instrument = FakeInstrument()
    with pytest.raises(QualityError, match="two views"):
        align(small(), instrument.connected(), StopRequest(), lambda event: None)
    assert_safe(instrument)


def test_a_stop_is_taken() -> None:
    stop = StopRequest()
    instrument = FakeInstrument(on_frame=lambda number: stop.stop() if number == 5 else None)
    with pytest.raises(ScanStopped):
        align(small(), instrument.connected(), stop, lambda event: None)
    assert_safe(instrument)
