"""Three slices from the projections so far equal those of the whole FBP volume."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.fbp import fbp
from recon.voxels.slices import orthogonal_slices

SHAPE, PITCH, RADIUS, HEIGHT = (20, 64), 0.1, 10.0, 9.0
GOLDEN = np.pi * (np.sqrt(5) - 1) / 2
SCANS = {
    "half a turn": (np.arange(90) * np.pi / 90, 33.0, 180.0),
    "golden": (np.arange(90) * GOLDEN, 30.0, 180.0),
    "a sector": (np.arange(40) * np.pi / 90, 31.5, 80.0),
    "a full turn about an axis at the side": (np.arange(180) * np.pi / 90, 12.0, 180.0),
}


def ball(angles: np.ndarray, axis_col: float, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """Line integrals [view, row, col] of a ball at (5, 8) pixels from the axis."""
    u, v = np.arange(shape[1]) - axis_col, np.arange(shape[0])[:, None] - HEIGHT
    centres = 5 * np.cos(angles) + 8 * np.sin(angles)
    chords = [2 * np.sqrt(np.clip(RADIUS**2 - (u - centre) ** 2 - v**2, 0, None)) for centre in centres]
    return np.asarray(np.stack(chords) * 0.3 * PITCH, np.float32)


@pytest.mark.parametrize("name", SCANS)
def test_they_are_slices_of_the_volume_through_its_matter(name: str) -> None:
    angles, axis_col, covered = SCANS[name]
    geometry = Geometry.parallel(angles, SHAPE, pixel_pitch=PITCH, axis_col=axis_col)
    data = ball(angles, axis_col)
    slices, volume = orthogonal_slices(list(data), geometry), fbp(data, geometry, None, "hann")
    k, j, i = (
        int(np.argmin(np.abs(axis - at)))
        for axis, at in zip(Grid.matching(geometry).coordinates(), slices.centre, strict=True)
    )
    for image, cut in zip(slices.images, (volume[k], volume[:, j], volume[:, :, i]), strict=True):
        assert image == pytest.approx(cut, abs=1e-5 * float(volume.max()))
    assert slices.centre[1:] == pytest.approx((8 * PITCH, 5 * PITCH), abs=PITCH)
    assert np.degrees(slices.covered) == pytest.approx(covered, abs=2.5)


def test_views_in_another_order_make_the_same_slices() -> None:
    angles, axis_col, _ = SCANS["half a turn"]
    data, mixed = ball(angles, axis_col), np.random.default_rng(0).permutation(angles.size)
    first, second = (
        orthogonal_slices(
            list(data[order]), Geometry.parallel(angles[order], SHAPE, pixel_pitch=PITCH, axis_col=axis_col)
        )
        for order in (np.arange(angles.size), mixed)
    )
    for one, other in zip(first.images, second.images, strict=True):
        assert one == pytest.approx(other, abs=1e-4)


def test_a_large_camera_is_binned() -> None:
    angles = np.arange(8) * GOLDEN
    shape = (6, 520)
    slices = orthogonal_slices(
        list(ball(angles, 259.0, shape)), Geometry.parallel(angles, shape, pixel_pitch=PITCH, axis_col=259.0)
    )
    assert slices.pixel == pytest.approx(2 * PITCH)
    assert [image.shape for image in slices.images] == [(260, 260), (3, 260), (3, 260)]


@pytest.mark.parametrize("views", [1, 3])
def test_views_without_their_angles_are_refused(views: int) -> None:
    angles = np.arange(1 if views == 1 else 4) * GOLDEN
    with pytest.raises(ValueError, match=f"{views} projections"):
        orthogonal_slices(list(ball(angles, 30.0)[:views]), Geometry.parallel(angles, SHAPE, pixel_pitch=PITCH))
