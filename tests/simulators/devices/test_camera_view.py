"""CameraView: an instrument's camera in the middle of its sensor sees what a scan of the scene alone sees."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from drivers.base.protocols import CameraSettings, TriggerSource
from drivers.orca_quest import LINE_TIME, SENSOR_SHAPE
from simulators.devices.in_beam import CameraView, Exposed
from simulators.scenes.expose import Scan
from tests.simulators import shots


@pytest.mark.parametrize("binning", [1, 2, 4])
@pytest.mark.parametrize("readout", LINE_TIME)
def test_a_scan_and_a_camera_with_its_roi_see_the_same(readout: Any, binning: Any) -> None:
    scene = replace(shots.scene("photon_noise"), axis_offset_px=3.4)
    asked = replace(scene.detector, shape=(64, 96), binning=binning, readout=readout)
    # Without effects of motion its stage stands in an exposure, as its file says; an instrument's turns on.
    scan = Scan.of(replace(scene, detector=asked, scan=replace(scene.scan, fly=False)), seed=7)
    of = scan.frame(25).shot
    settings = CameraSettings(asked.exposure_s, TriggerSource.EXTERNAL, scan.roi, binning, readout)
    view = CameraView(scan.scene, settings, asked.pixel_size_um * 1e-3, 7, of.angle_at, connected=scan.start)
    frame = Exposed(3, of.frame, of.time, of.angle, of.time + 1.0, True, 0.0, of.view)
    seen, expected = asdict(view.shot(frame)), asdict(of)
    for name, value in expected["detector"].items():
        assert seen["detector"][name] == pytest.approx(value, rel=1e-12), name
    assert seen.pop("row_period") == pytest.approx(expected.pop("row_period"), rel=1e-12)
    assert {**seen, "detector": None} == {**expected, "detector": None}


@pytest.mark.parametrize(("effects", "seen"), [((), 0.42), (("motion_blur",), 0.4), (("rolling_shutter",), 0.4)])
def test_a_frame_without_motion_shows_the_middle_of_its_exposure(effects: tuple[str, ...], seen: float) -> None:
    """Effects of motion ask for the moments of the exposure themselves, from the trigger on."""
    settings = CameraSettings(0.01, TriggerSource.EXTERNAL, (0, 0, 64, 96))
    view = CameraView(shots.scene(*effects), settings, 4.6e-3, 1, lambda time: 0.4 + 4.0 * (time - 1000.0), 0.0)
    assert view.shot(Exposed(0, 0, 1000.0, 0.4, 1000.1, True, 0.0, 0)).angle == pytest.approx(seen)


def test_without_a_roi_it_is_the_whole_sensor() -> None:
    view = CameraView(shots.scene(), CameraSettings(0.01, TriggerSource.INTERNAL), 4.6e-3, 1, shots.never, 0.0)
    assert view.roi == (0, 0, *SENSOR_SHAPE)
    assert view.detector.shape == SENSOR_SHAPE
    assert (view.detector.axis_row, view.detector.axis_col) == tuple((np.array(SENSOR_SHAPE) - 1) / 2)
