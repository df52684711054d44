"""Exposure without effects: Beer-Lambert, on any number of threads."""

from __future__ import annotations

import math
import re
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.frame import FrameKind
from drivers.base.protocols import CameraSettings, TriggerSource
from drivers.orca_quest import timing
from simulators.effects.chain import Chain
from simulators.frame.mapping import SceneError
from simulators.frame.shot import Detector, Pose
from simulators.light import Beam
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid
from simulators.samples.sample import Sample
from simulators.scenes.expose import Scan, expose
from simulators.scenes.scene import Scene, load_scene
from tests.messages import refused
from tests.simulators import shots
from tests.simulators.bodies import SOLIDS
from tests.simulators.shots import PHANTOM

ALL = Phantom.of(list(SOLIDS.values()))


def _scene(sample: Sample, photons_per_s: float = 4e5) -> Scene:
    return Scene(sample=sample, beam=Beam(photons_per_s), chain=Chain.of([]))


def test_a_frame_without_effects_is_beer_lambert_rounded_and_clipped() -> None:
    """From amplified light to where the exponential underflows."""
    for attenuation in (-500.0, -3.0, 0.0, 3.0, 1400.0, 1e6):
        sample = Phantom.of([Ellipsoid((0.3, 0.2, 0.25), attenuation), Cylinder(0.35, 0.3, attenuation)])
        shot = shots.shot(angle=0.3)
        with np.errstate(over="ignore"):
            light = 4e5 * shot.exposure * shot.binning**2 * np.exp(-sample.line_integrals(0.3, shot.detector))
            counts = expose(_scene(sample), shot)
        np.testing.assert_array_equal(counts, np.rint(np.minimum(light / shot.conversion, 65535)))


@pytest.mark.parametrize("threads", [2, 3, 7])
@pytest.mark.parametrize("sod", [math.inf, 2.0])
def test_threads_change_no_bit(threads: int, sod: float, monkeypatch: pytest.MonkeyPatch) -> None:
    detector = Detector((300, 310), 0.004, 150.2, 144.4, sod)
    pose = Pose.turned(np.linspace(0.2, 0.3, 300), 300)

    def frames() -> list[NDArray[Any]]:
        counts = expose(_scene(ALL), shots.shot(detector=detector))
        return [counts, ALL.line_integrals(0.7, detector), ALL.line_integrals(pose, detector)]

    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 1)
    alone = frames()
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
    for one, many in zip(alone, frames(), strict=True):
        np.testing.assert_array_equal(one, many)


SETTINGS = {
    "detector": {"shape": [24, 32], "pixel_size_um": 20.0, "exposure_s": 0.02},
    "scan": {"views": 6, "range_deg": 180.0, "period_s": 0.1, "darks": 2, "flats": 3},
}


def _scan(*effects: Any, views: int | None = None, **changes: Any) -> Scan:
    settings = {key: value | changes.get(key, {}) for key, value in SETTINGS.items()}
    mapping = {"phantom": PHANTOM, "beam": {"photons_per_s": 1e5}, "effects": list(effects), "axis_offset_px": 2.0}
    return Scan.of(load_scene(mapping | settings), seed=3, views=views, start=1000.0)


def test_darks_come_first_then_flats_then_the_views() -> None:
    scan = _scan()
    frames = list(scan)
    assert len(frames) == len(scan) == 11
    kinds = [FrameKind.DARK] * 2 + [FrameKind.FLAT] * 3 + [FrameKind.PROJECTION] * 6
    assert [frame.kind for frame in frames] == kinds
    assert [(frame.shot.beam, frame.shot.sample) for frame in frames[1:6:2]] == [
        (False, False),
        (True, False),
        (True, True),
    ]
    assert [frame.shot.frame for frame in frames] == list(range(11))
    assert [frame.shot.view for frame in frames[5:]] == list(range(6))
    np.testing.assert_allclose([frame.shot.time for frame in frames], 1000 + 0.1 * np.arange(11))
    np.testing.assert_allclose([frame.shot.elapsed for frame in frames], 0.1 * np.arange(11))
    np.testing.assert_allclose(np.degrees([frame.shot.angle for frame in frames[5:]]), [0, 30, 60, 90, 120, 150])


def test_fewer_views_are_spread_over_the_same_range() -> None:
    np.testing.assert_allclose(np.degrees([frame.shot.angle for frame in list(_scan(views=3))[5:]]), [0, 60, 120])


@pytest.mark.parametrize(
    ("fly", "views", "period"), [(True, 3, 0.2), (True, 4, 0.15), (True, 12, 0.1), (False, 3, 0.1)]
)
def test_a_flying_stage_turns_no_faster_for_fewer_views(fly: bool, views: int, period: float) -> None:
    scan = _scan(views=views, scan={"fly": fly})
    first, second = (scan.frame(number).shot for number in (5, 6))
    assert scan.period == pytest.approx(period)
    assert second.time - first.time == pytest.approx(period)
    assert second.elapsed - first.elapsed == pytest.approx(period)
    if fly:
        assert first.angle_at(second.time) == pytest.approx(second.angle)
        speed = math.degrees(first.angle_at(first.time + 0.01)) / 0.01
        assert speed == pytest.approx(min(300.0, 180 / views / period))


def test_a_flying_stage_turns_steadily_and_a_stepping_one_stands() -> None:
    flying = _scan().frame(7).shot
    speed = math.radians(30) / 0.1
    for later in (-0.05, 0.0, 0.013):
        assert flying.angle_at(flying.time + later) == pytest.approx(flying.angle + speed * later)
    standing = _scan(scan={"fly": False}).frame(7).shot
    assert standing.angle_at(standing.time + 0.02) == standing.angle


def test_any_frame_is_the_same_alone() -> None:
    scan = _scan("photon_noise", "read_noise")
    in_turn = [expose(scan.scene, planned.shot) for planned in scan]
    for number in (10, 0, 7):
        np.testing.assert_array_equal(
            expose(scan.scene, _scan("photon_noise", "read_noise").frame(number).shot), in_turn[number]
        )
    assert (in_turn[5] != in_turn[6]).any()
    assert not expose(_scan().scene, scan.frame(0).shot).any()  # a dark without noise


def test_pixels_lie_in_the_middle_of_the_sensor_and_the_axis_where_the_scene_has_it() -> None:
    scan = _scan(detector={"binning": 2})
    assert scan.detector.pitch == pytest.approx(0.04)
    assert scan.detector.axis_col == pytest.approx(15.5 + 1.0)
    assert scan.detector.axis_row == 11.5
    row0, col0, rows, cols = scan.roi
    assert (rows, cols) == (48, 64)
    assert (2 * row0 + rows, 2 * col0 + cols) == (2304, 4096)


@pytest.mark.parametrize("readout", ["standard", "ultra_quiet", "photon_number"])
@pytest.mark.parametrize("binning", [1, 2, 4])
def test_rows_start_as_late_as_the_camera_s(readout: str, binning: int) -> None:
    settings = {"binning": binning, "readout": readout, "shape": [24, 32]}
    camera = timing(CameraSettings(0.02, TriggerSource.INTERNAL, roi=(0, 0, 96, 128), readout=readout, binning=binning))
    assert _scan(detector=settings).frame(5).shot.row_period == pytest.approx(camera.row_period, rel=1e-12)


def test_a_converter_of_ones_own_has_its_electrons_a_count() -> None:
    scan = _scan(detector={"electrons_per_count": 2.0})
    assert (expose(scan.scene, scan.frame(3).shot) == 1000).all()  # 1e5/s x 0.02 s / 2


def test_what_cannot_be_is_refused() -> None:
    with refused(IndexError):
        _scan().frame(11)
    with refused(ValueError):
        _scan(views=0)
    for changes, words in (
        ({"detector": {"shape": [2400, 100]}}, "do not fit on the sensor of 2304 x 4096"),
        ({"detector": {"shape": [1200, 100], "binning": 2}}, "do not fit on the sensor"),
        ({"detector": {"binning": 3}}, "binning is 3; expected 1 | 2 | 4"),
        ({"detector": {"electrons_per_count": 0}}, "electrons_per_count is 0; expected a number > 0"),
        ({"detector": {"exposure_s": 0}}, "exposure_s is 0; expected a number > 0"),
        ({"detector": {"readout": "fast"}}, "readout is 'fast'; expected standard | ultra_quiet | photon_number"),
        ({"scan": {"views": 0}}, "views is 0; expected a whole number >= 1"),
        ({"scan": {"flats": 10**7}}, "flats is 10000000; expected a whole number >= 0 and <= 1e+06"),
        ({"scan": {"range_deg": -1e9}}, "range_deg is -1000000000.0; expected a number >= -1e+06"),
        ({"scan": {"period_s": 1e308}}, "period_s is 1e+308; expected a number > 0 and <= 1e+06"),
        ({"detector": {"pixel_size_um": 1e-308}}, "pixel_size_um is 1e-308; expected a number >= 0.001"),
    ):
        with pytest.raises(SceneError, match=re.escape(words)):
            _scan(**changes)
