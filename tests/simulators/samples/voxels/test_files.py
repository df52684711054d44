"""Volumes and meshes from files."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from simulators.frame.mapping import SceneError
from simulators.frame.shot import Detector
from simulators.light import Beam
from simulators.samples.composed import build_sample
from simulators.samples.sample import Stored
from simulators.samples.voxels.files import VolumeSettings, filled, require_closed, volume_sample
from simulators.samples.voxels.voxels import Voxels
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
        ({"voxel_mm": -1.0}, "voxel_mm must be greater than 0"),
        ({"window": [3.0, 3.0], "scale": 1.0}, r"window must be \(low, high\)"),
        ({"window": [3.0, 4.0]}, "a window needs attenuation_max"),
        ({"scale": 1.0, "attenuation_max": 2.0}, "scale and attenuation_max exclude each other"),
        ({"file": 7}, "file must be text"),
        ({"thresholds": [3.0, 2.0]}, "thresholds must ascend"),
        ({"voxel_mm": None}, "voxel_mm is missing"),
        ({"file": "flat"}, "three axes"),
        ({"file": "complex"}, "real values"),
        ({"file": "thin", "voxel_mm": None, "largest_line_integral": 2.0}, "too anisotropic for largest_line_integral"),
        ({"file": "none", "largest_line_integral": 2.0}, "needs matter"),
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


def hull_mesh(points: np.ndarray) -> np.ndarray:
    """Triangles [triangle, corner, xyz] of a convex hull, anticlockwise seen from outside."""
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normal, hull.equations[:, :3]) < 0
    corners[inward] = corners[inward][:, ::-1]
    return corners


def sphere(n: int, radius: float) -> np.ndarray:
    """A mesh of n corners on a sphere (Fibonacci's lattice)."""
    k = np.arange(n) + 0.5
    turn, z = np.pi * (1 + 5**0.5) * k, 1 - 2 * k / n
    flat = np.sqrt(1 - z**2)
    return hull_mesh(radius * np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1))


def test_a_box_on_the_voxels_edges_fills_them_and_no_others() -> None:
    corners = np.array([(x, y, z) for x in (-1.5, 2.5) for y in (-0.5, 1.5) for z in (-2.5, 0.5)])
    share = filled(hull_mesh(corners), 1.0)
    z, y, x = (np.arange(n) - n // 2 for n in share.shape)
    inside = np.ix_((z >= -2) & (z <= 0), (y >= 0) & (y <= 1), (x >= -1) & (x <= 2))
    assert share[inside] == pytest.approx(1, abs=1e-6) and share.sum() == pytest.approx(24, abs=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_shares_are_those_of_a_convex_body(rng: np.random.Generator, seed: int) -> None:
    """Its volume by the hull; voxels whose corners are all inside, or far outside, by the hull's planes."""
    points = np.random.default_rng(seed).normal(size=(20, 3)) * 4
    hull, share = ConvexHull(points), filled(hull_mesh(points), 0.5)
    assert share.sum() * 0.125 == pytest.approx(hull.volume, rel=3e-3)
    z, y, x = np.meshgrid(*((np.arange(n) - n // 2) * 0.5 for n in share.shape), indexing="ij")
    deep = (np.stack([x, y, z], axis=-1) @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=-1)
    assert (share[deep < -0.45] > 0.9999).all() and (share[deep > 0.45] < 1e-4).all()


def test_a_hollow_and_a_mesh_turned_inside_out() -> None:
    shell = np.concatenate([sphere(2000, 4.0), sphere(2000, 2.0)[:, ::-1]])
    share = filled(shell, 0.25)
    assert share[tuple(n // 2 for n in share.shape)] == pytest.approx(0, abs=1e-5)
    assert share.sum() * 0.25**3 == pytest.approx(4 / 3 * np.pi * (64 - 8), rel=5e-3)
    np.testing.assert_allclose(filled(shell[:, ::-1], 0.25), share, atol=1e-5)


def test_an_open_mesh_is_refused_and_a_closed_one_is_a_sample() -> None:
    ball = sphere(200, 1000.0)
    require_closed(ball)
    turned = np.concatenate([ball[:1, ::-1], ball[1:]])
    for wrong, lacking in ((ball[1:], 3), (turned, 6), (np.concatenate([ball, ball[:1]]), 3), (ball[:0], 0)):
        with pytest.raises(ValueError, match=f"is open: {lacking} of"):
            require_closed(wrong)
    entry = {"kind": "mesh", "file": "b.stl", "unit": "um", "attenuation": 2.0, "voxel_mm": 0.1}
    beam = Beam(1e5)
    sample = build_sample("phantom", entry, beam, lambda file, dataset: Stored(ball))
    assert sample.radius == pytest.approx(1.1, abs=0.1) and sample.names == ("matter",)
    for change, said in (({"unit": "inch"}, "unit"), ({"voxel_mm": 1e-4}, "too many")):
        with pytest.raises(SceneError, match=said):
            build_sample("phantom", entry | change, beam, lambda file, dataset: Stored(ball))
