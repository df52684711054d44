"""Meshes as samples: shares of voxels against polyhedra whose volume and inside are known; open ones are refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from simulators.frame.mapping import SceneError
from simulators.light.beam import Beam
from simulators.samples.composed.phantoms import build_sample
from simulators.samples.sample import Stored
from simulators.samples.voxels.mesh import filled, require_closed


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
