"""Surfaces of voxels against spheres and cubes that are known, and their closedness on noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.volume import Grid
from recon.features import surfaces as module
from recon.features.surfaces import Mesh, half_way, surface

pytest.importorskip("skimage")
GRID = Grid((40, 44, 48), 0.02, (0.3, 0.0, 0.0))
MIDDLE = np.array([0.013, -0.007, 0.309])
TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]


def shares(inside: object, grid: Grid = GRID, fine: int = 4) -> NDArray[np.float32]:
    """Share of each voxel that lies inside, by `fine`³ points."""
    finer = Grid(tuple(n * fine for n in grid.shape), grid.voxel_size / fine, grid.centre)
    z, y, x = finer.coordinates()
    points = np.stack(np.broadcast_arrays(x[None, None], y[None, :, None], z[:, None, None]), -1) - MIDDLE
    found = inside(points).astype(np.float32)  # type: ignore[operator]
    nz, ny, nx = grid.shape
    return found.reshape(nz, fine, ny, fine, nx, fine).mean(axis=(1, 3, 5))


def from_sphere(points: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.linalg.norm(points - MIDDLE, axis=1) - 0.3


def from_cube(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Distance from the surface of a turned cube of edge 0.44."""
    q = np.abs((points - MIDDLE) @ TURN) - 0.22
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def in_sphere(d: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray(np.linalg.norm(d, axis=-1) < 0.3)


def in_cube(d: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray((np.abs(d @ TURN) < 0.22).all(axis=-1))


def assert_closed(mesh: Mesh) -> None:
    """Each edge twice, once in each direction, and no two vertices in one place: as STL, too, it is closed."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    found, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 1).all()
    np.testing.assert_array_equal(found, np.unique(found[:, ::-1], axis=0))
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    assert mesh.euler == len(mesh.vertices) - len(found) // 2 + len(mesh.faces)


@pytest.mark.parametrize(
    ("inside", "distance", "volume"),
    [
        pytest.param(in_sphere, from_sphere, 4 / 3 * np.pi * 0.3**3, marks=pytest.mark.slow),
        (in_cube, from_cube, 0.44**3),
    ],
)
def test_a_sphere_and_a_turned_cube_within_a_tenth_of_a_voxel(inside: object, distance: object, volume: float) -> None:
    data = 3 * shares(inside)
    level = half_way(data, len(data))
    assert level == pytest.approx(1.5, rel=0.02)
    mesh = surface(data, GRID, level)
    rms = np.sqrt(np.mean(distance(mesh.vertices.astype(np.float64)) ** 2)) / GRID.voxel_size  # type: ignore[operator]
    assert rms < 0.1
    assert mesh.volume == pytest.approx(volume, rel=0.01)
    assert mesh.euler == 2
    assert_closed(mesh)


def test_noise_through_all_faces_is_closed_and_the_same_in_slabs(monkeypatch: pytest.MonkeyPatch) -> None:
    data = np.random.default_rng(0).normal(size=(17, 20, 23)).astype(np.float32)
    data[3:6, 4, 5] = 0.1  # on the level itself
    grid = Grid(data.shape, 1.0, slice_pitch=2.0)
    whole = surface(data, grid, 0.1)
    assert_closed(whole)
    monkeypatch.setattr(module, "BLOCK", 3 * 22 * 25)
    slabs = surface(data, grid, 0.1)
    assert_closed(slabs)
    assert slabs.volume == pytest.approx(whole.volume, rel=1e-5)
    assert (len(slabs.vertices), len(slabs.faces)) == (len(whole.vertices), len(whole.faces))
    low, high = grid.edges
    assert (whole.vertices >= low).all() and (whole.vertices <= high).all()


def test_a_full_box_is_closed_at_its_faces() -> None:
    mesh = surface(np.ones((3, 4, 5), np.float32), Grid((3, 4, 5)), 0.5)
    assert_closed(mesh)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (5, 4, 3), rtol=1e-5)
    assert mesh.euler == 2


def test_neither_a_speck_of_metal_nor_a_small_body_in_empty_air_misleads_the_level() -> None:
    data = np.zeros((20, 40, 40), np.float32)
    data[:, 10:30, 10:30] = 1.0
    data[9:11, 19:21, 19:21] = 50.0
    assert half_way(data, 20) == 0.5
    alone = np.zeros((20, 40, 40), np.float32)
    alone[8:12, 18:22, 18:22] = 1.0
    assert half_way(alone, 20) == 0.5


def test_what_has_no_surface_or_too_much_is_refused() -> None:
    data = np.random.default_rng(0).normal(size=(8, 8, 8)).astype(np.float32)
    with pytest.raises(ValueError, match="level 9"):
        surface(data, Grid(data.shape), 9.0)
    with pytest.raises(ValueError, match="noise has much surface"):
        surface(data, Grid(data.shape), 0.0, most=1e4)
    data[2, 3, 4] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        surface(data, Grid(data.shape), 0.0)


def test_slabs_of_air_are_counted_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "BLOCK", 3 * 12 * 12)
    data = np.zeros((30, 10, 10), np.float32)
    data[10:13, 4:6, 4:6] = 1
    done = list[tuple[int, int]]()
    surface(data, Grid(data.shape), 0.5, count=lambda n, of: done.append((n, of)))
    assert done == [(min(n, 30), 30) for n in range(3, 33, 3)] + [(30, 30)]
