"""Volumes from files."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from simulators.frame.mapping import SceneError
from simulators.frame.shot import Detector
from simulators.light import Beam
from simulators.samples.composed import build_sample
from simulators.samples.sample import Stored
from simulators.samples.voxels.voxels import VolumeSettings, Voxels, volume_sample
from simulators.scenes.scene import load_scene

VALUES = np.arange(60, dtype=np.int16).reshape(3, 4, 5) - 10


def _voxels(values: np.ndarray = VALUES, spacing: Any = None, **settings: Any) -> Voxels:
    def read(file: str, dataset: str | None) -> Stored:
        return Stored(values if file == "v" else values.clip(0, 3), spacing)

    return volume_sample(VolumeSettings("v", **({"voxel_mm": 0.1} | settings)), read)


def _values(voxels: Voxels) -> np.ndarray:
    return voxels.padded[1:-1, 1:-1, 1:-1]


def test_values_become_attenuation_as_the_scene_says() -> None:
    np.testing.assert_array_equal(_values(_voxels()), VALUES)
    np.testing.assert_allclose(_values(_voxels(scale=0.5)), VALUES * 0.5)
    np.testing.assert_allclose(_values(_voxels(attenuation_max=7.0)), VALUES * 7 / 49, rtol=1e-6)
    clipped = (VALUES.clip(10, 30) - 10) / 20
    np.testing.assert_allclose(_values(_voxels(window=(10, 30), attenuation_max=4.0)), clipped * 4, rtol=1e-6)
    np.testing.assert_allclose(_values(_voxels(window=(10, 30), scale=0.1)), clipped * 2, rtol=1e-6)


def test_the_largest_line_integral_is_as_asked() -> None:
    """Of a uniform box it is the sum along its longest row, or a diagonal: here along x, 20 voxels of 0.1 mm."""
    voxels = _voxels(np.full((6, 4, 20), 3.0), largest_line_integral=2.5)
    np.testing.assert_allclose(_values(voxels), 2.5 / 2.0, rtol=1e-5)
    seen = [voxels.line_integrals(angle, Detector.centred((6, 30), 0.1)).max() for angle in np.arange(8) * np.pi / 8]
    assert max(seen) == pytest.approx(2.5, rel=1e-5)


@pytest.mark.parametrize("tall", [1e-6, 0.3, 1e6])
def test_the_largest_line_integral_of_tall_and_of_flat_voxels_is_that_of_a_plane(tall: float) -> None:
    """A frame as fine as the finest of a voxel's edges would take all memory."""
    values = np.zeros((5, 4, 20))
    values[3] = 3.0
    voxels = _voxels(values, voxel_mm=None, spacing=(tall, 0.1, 0.1), largest_line_integral=2.5)
    np.testing.assert_allclose(_values(voxels).max(), 2.5 / 2.0, rtol=1e-5)


def test_axes_and_sizes_follow_the_file() -> None:
    voxels = _voxels(axes="xyz")
    np.testing.assert_array_equal(_values(voxels), VALUES.transpose(2, 1, 0))
    assert _voxels(voxel_mm=None, spacing=(3.0, 2.0, 1.0)).spacing == (3.0, 2.0, 1.0)
    assert _voxels(voxel_mm=None, spacing=(3.0, 2.0, 1.0), axes="xyz").spacing == (1.0, 2.0, 3.0)
    assert _voxels(voxel_mm=0.1, spacing=(3.0, 2.0, 1.0)).spacing == pytest.approx((0.3, 0.2, 0.1))


def test_thresholds_and_labels_are_of_the_files_values() -> None:
    from recon.base.volume import Grid

    grid = Grid((3, 4, 5), 0.1)
    voxels = _voxels(window=(-10, 49), attenuation_max=3.3, thresholds=(7, 23), names=("low", "high"))
    np.testing.assert_array_equal(voxels.labels(grid), np.digitize(VALUES, [7, 23]))
    assert voxels.names == ("low", "high")
    np.testing.assert_array_equal(_voxels(labels="labels").labels(grid), VALUES.clip(0, 3))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"axes": "zyy"}, "axes must name x, y and z"),
        ({"voxel_mm": -1.0}, "voxel_mm is -1.0; expected a number > 0"),
        ({"window": [3.0, 3.0], "scale": 1.0}, r"window must be \(low, high\)"),
        ({"window": [3.0, 4.0]}, "a window needs attenuation_max"),
        ({"scale": 1.0, "attenuation_max": 2.0}, "scale and attenuation_max exclude each other"),
        ({"file": 7}, "file is 7; expected text"),
        ({"thresholds": [3.0, 2.0]}, "thresholds must ascend"),
        ({"voxel_mm": None}, "voxel_mm is missing"),
        ({"file": "flat"}, "three axes"),
        ({"file": "complex"}, "real values"),
        ({"file": "thin", "voxel_mm": None, "largest_line_integral": 2.0}, "too anisotropic for largest_line_integral"),
        ({"file": "none", "largest_line_integral": 2.0}, "needs a sample that absorbs"),
        ({"file": "none", "attenuation_max": 2.0}, "needs a value above 0"),
    ],
)
def test_wrong_settings_are_refused_by_name(changed: dict[str, Any], message: str) -> None:
    def read(file: str, dataset: str | None) -> Stored:
        volumes = {"v": VALUES, "flat": VALUES[0], "complex": VALUES * 1j, "none": VALUES * 0}
        return Stored(VALUES, (1.0, 1.0, 1e-9)) if file == "thin" else Stored(volumes[file])

    with pytest.raises(SceneError, match=message):
        build_sample("phantom", {"kind": "volume", "file": "v", "voxel_mm": 0.1} | changed, Beam(1e5), read)


def test_without_a_reader_no_volume_can_be_named() -> None:
    with pytest.raises(SceneError, match=r"scene\.phantom \(volume\): v\.tif"):
        load_scene({"phantom": {"kind": "volume", "file": "v.tif"}, "beam": {"photons_per_s": 1e5}})
