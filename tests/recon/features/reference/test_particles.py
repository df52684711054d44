"""Parts of a reference, and its place on the voxels of a state."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from recon.base.volume import Grid, Volume
from recon.features.reference.particles import bytes_placed, particles_of, placed, summits
from tests.recon.features.reference.scene import LEVEL, ROWS, N, packed


def test_ground_and_particles_are_found() -> None:
    scene = packed()
    volume = scene.volume.transpose(1, 2, 0)
    parts = particles_of(volume)
    assert parts is not None
    assert parts.base == pytest.approx(0.2 * LEVEL, rel=0.05) and parts.level == pytest.approx(0.8 * LEVEL, rel=0.1)
    assert parts.count == len(scene.at)
    np.testing.assert_allclose(parts.volume, volume, atol=1e-7)
    middles = np.rint(scene.at + (N - 1) / 2).astype(int)
    labels = parts.label[middles[:, 0], middles[:, 1], ROWS // 2]
    assert (labels > 0).all() and len(np.unique(labels)) == len(labels)


@pytest.mark.parametrize("value", [0.0, 0.3])
def test_a_uniform_volume_has_no_parts(value: float) -> None:
    assert particles_of(np.full((8, 8, 2), value, np.float32)) is None


def test_voxels_climb_to_the_nearest_summit() -> None:
    x = np.arange(40.0)
    depth = np.maximum(5 - np.abs(x - 8), 5 - np.abs(x - 20))[None, :, None].astype(np.float32)
    label = summits(depth, depth > 0)[0, :, 0]
    assert set(label[4:13]) == {1} and set(label[16:25]) == {2} and not label[:3].any()


def test_a_reference_is_put_on_the_voxels_of_a_state(rng: np.random.Generator) -> None:
    data = rng.random((6, 8, 8), np.float32)
    reference = Volume(data, Grid((6, 8, 8), 0.5))
    whole, first = placed(reference, reference.grid, 3)
    assert first == (0, 0, 0)
    np.testing.assert_array_equal(whole, data.transpose(1, 2, 0))
    part = reference.grid.part(slice(2, 4), slice(1, 8), slice(0, 8))
    rows, first = placed(reference, part, 1)
    assert first == (1, 0, 1) and rows.shape == (8, 8, 4)  # one voxel of margin, as far as the reference reaches
    np.testing.assert_array_equal(rows, data[1:5].transpose(1, 2, 0))
    wide, first = placed(reference, Grid((6, 12, 12), 0.5), 0)
    assert first == (-2, -2, 0) and wide.shape == (8, 8, 6)


@pytest.mark.parametrize("edge", [0.5, 0.7, 2.0])
def test_the_stated_memory_is_that_of_a_reference_on_the_voxels_of_a_state(
    edge: float, rng: np.random.Generator
) -> None:
    reference = Volume(rng.random((96, 128, 128), np.float32), Grid((96, 128, 128), 0.5))
    grid = Grid((round(24 / edge), round(56 / edge), round(56 / edge)), edge)
    tracemalloc.start()
    volume = placed(reference, grid, 4)[0]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    size, smoothed = bytes_placed(reference.grid, grid, 4)
    assert volume.nbytes <= size < 1.2 * volume.nbytes
    assert peak < 2.1 * size + 1.1 * smoothed and (smoothed > 0) == (edge > 1)


def test_coarser_voxels_have_the_means_of_the_reference() -> None:
    z, y, x = np.meshgrid(np.arange(8), np.arange(8), np.arange(8), indexing="ij")
    reference = Volume((z + 2 * y + 3 * x).astype(np.float32), Grid((8, 8, 8), 0.5))
    coarse, first = placed(reference, Grid((4, 4, 4), 1.0), 0)
    assert first == (0, 0, 0)
    expected = reference.data.reshape(4, 2, 4, 2, 4, 2).mean((1, 3, 5)).transpose(1, 2, 0)
    np.testing.assert_allclose(coarse[1:3, 1:3, 1:3], expected[1:3, 1:3, 1:3], atol=1e-4)


def test_a_reference_elsewhere_is_refused() -> None:
    reference = Volume(np.ones((4, 4, 4), np.float32), Grid((4, 4, 4), 1.0))
    with pytest.raises(ValueError, match="do not overlap; give a volume of the same sample"):
        placed(reference, Grid((4, 4, 4), 1.0, centre=(100.0, 0.0, 0.0)), 2)
