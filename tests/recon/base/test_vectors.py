"""Geometries from vectors: compared with rays traced with the vectors, and converted back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import recon
from recon.base.geometry import Geometry
from recon.base.kernel import RayModel, Truncation
from recon.base.vectors import geometry_of_vectors, vectors_of
from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from recon.voxels.projector import Projector
from tests.messages import refused

F64 = NDArray[np.float64]
SHAPE = (18, 22)


def frames(rng: np.random.Generator, views: int) -> F64:
    """Random right-handed frames [view, 3, 3]: u, v, and v x u."""
    u, v, _ = np.linalg.qr(rng.normal(size=(views, 3, 3)))[0].transpose(2, 0, 1)
    return np.stack((u, v, np.cross(v, u)), 1)


def free_cone(rng: np.random.Generator, views: int, off: float = 0.3) -> F64:
    """Sources in any direction, about 10 mm away; detectors at 15 mm from them, which need not face the origin."""
    u, v, beam = frames(rng, views).transpose(1, 0, 2)
    source = -10 * beam + off * rng.normal(size=(views, 3))
    middle = source + 15 * beam + off * (rng.normal(size=(views, 1)) * u + rng.normal(size=(views, 1)) * v)
    return np.hstack((source, middle, 0.1 * u, 0.1 * v))


def free_parallel(rng: np.random.Generator, views: int) -> F64:
    u, v, beam = frames(rng, views).transpose(1, 0, 2)
    sign = rng.choice((-2.0, 3.0), (views, 1))  # either way along the beam, and any length
    middle = 0.2 * rng.normal(size=(views, 3))
    return np.hstack((sign * beam, middle, 0.07 * u, 0.07 * v))


def rays(vectors: F64, shape: tuple[int, int], *, cone: bool) -> tuple[F64, F64]:
    """A point and the unit direction of each pixel's ray, [view, row, col, 3]: nothing but the definition."""
    first, middle, u, v = vectors.reshape(-1, 4, 1, 1, 3).transpose(1, 0, 2, 3, 4)
    row, col = (at[..., None] - (n - 1) / 2 for at, n in zip(np.indices(shape), shape, strict=True))
    pixel = middle + col * u + row * v
    run = pixel - first if cone else np.broadcast_to(first, pixel.shape)
    return pixel, run / np.linalg.norm(run, axis=-1, keepdims=True)


@given(st.integers(0, 2**31), st.booleans(), st.integers(1, 5))
@settings(max_examples=15)
def test_vectors_make_a_geometry_with_the_same_vectors(seed: int, cone: bool, views: int) -> None:
    rng = np.random.default_rng(seed)
    given_vectors = free_cone(rng, views) if cone else free_parallel(rng, views)
    geometry = geometry_of_vectors(given_vectors, SHAPE, cone=cone)
    found = vectors_of(geometry)
    if cone:
        np.testing.assert_allclose(found, given_vectors, atol=1e-9)
        assert geometry.offsets[0] == pytest.approx(
            np.array(_pixel_of_origin(given_vectors[0])) - (geometry.axis_col, geometry.axis_row)
        )
    else:
        points, along = rays(given_vectors, SHAPE, cone=False)
        again, same = rays(found, SHAPE, cone=False)
        np.testing.assert_allclose(np.linalg.norm(np.cross(along, same), axis=-1), 0, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(np.cross(points - again, along), axis=-1), 0, atol=1e-9)


def _pixel_of_origin(vectors: F64) -> tuple[float, float]:
    """(col, row) where the ray through the origin meets the detector of one view of a cone."""
    source, middle, u, v = vectors.reshape(4, 3)
    col, row, _ = np.linalg.solve(np.stack((u, v, source), 1), source - middle)
    return col + (SHAPE[1] - 1) / 2, row + (SHAPE[0] - 1) / 2


@pytest.mark.parametrize("cone", [False, True])
def test_voxels_and_gaussians_are_projected_along_the_rays_of_vectors(cone: bool) -> None:
    """A Gaussian has the integral sqrt(2π) / |H d| exp(-a² / 2) along d, which passes it at a of its widths 1 / H."""
    rng = np.random.default_rng(4)
    vectors = free_cone(rng, 6) if cone else free_parallel(rng, 6)
    geometry = geometry_of_vectors(vectors, SHAPE, cone=cone)
    widths, centre = np.array([0.17, 0.12, 0.14]), np.array([0.1, -0.15, 0.05])
    point, along = rays(vectors, SHAPE, cone=cone)
    p, d = (point - centre) / widths, along / widths
    square = (d * d).sum(-1)
    expected = np.sqrt(2 * np.pi / square) * np.exp(-((p * p).sum(-1) - (p * d).sum(-1) ** 2 / square) / 2)

    blob = Gaussians.from_physical(centre[None], widths[None], np.ones(1))
    exact = recon.project(blob, geometry, truncation=Truncation(9.0, 1e-12), model=RayModel(exact_above=0.0))
    np.testing.assert_allclose(exact.detach().numpy(), expected, atol=2e-5 * expected.max())
    grid = Grid((34, 36, 36), 0.04, (0.05, -0.15, 0.1))
    found = Projector(geometry, grid).forward(recon.voxelize(blob, grid).numpy())
    np.testing.assert_allclose(found, expected, atol=0.02 * expected.max())


def test_circular_views_of_other_programs_are_plain_ones() -> None:
    """The circle of ASTRA's `cone` and `parallel3d`, written as vectors."""
    angles = np.linspace(0, 2 * np.pi, 7, endpoint=False)
    c, s, none = np.cos(angles), np.sin(angles), np.zeros(7)
    pixels = 0.5 * c, 0.5 * s, none, none, none, none + 0.5
    cone = geometry_of_vectors(np.stack((20 * s, -20 * c, none, -30 * s, 30 * c, none, *pixels), 1), SHAPE, cone=True)
    parallel = geometry_of_vectors(np.stack((s, -c, none, none, none, none, *pixels), 1), SHAPE, cone=False)
    assert cone.is_straight and parallel.is_straight and not cone.shifts.any()
    for found, expected in (
        (cone, Geometry.cone(angles, SHAPE, 0.5, 20.0, 50.0)),
        (parallel, Geometry.parallel(angles, SHAPE, pixel_pitch=0.5)),
    ):
        np.testing.assert_allclose(vectors_of(found), vectors_of(expected), atol=1e-12)


def test_views_that_no_such_detector_has_are_refused_with_the_view_and_by_how_much() -> None:
    rng = np.random.default_rng(2)
    cone = free_cone(rng, 3)
    cone[1, 6:9] *= 1.02
    with refused(ValueError):
        geometry_of_vectors(cone, SHAPE, cone=True)
    cone = free_cone(rng, 3)
    cone[2, 9:] *= -1
    with refused(ValueError):
        geometry_of_vectors(cone, SHAPE, cone=True)
    with refused(ValueError):
        geometry_of_vectors([(0, -10, 0, 0, -5, 0, 0.1, 0, 0, 0, 0, 0.1)], SHAPE, cone=True)
    oblique = free_parallel(rng, 2)
    oblique[1, :3] = oblique[1, 6:9] * 5 + np.cross(oblique[1, 9:], oblique[1, 6:9]) * 9
    with refused(ValueError):
        geometry_of_vectors(oblique, SHAPE, cone=False)
    with refused(ValueError):
        oblique[1, :3] = oblique[1, 6:9]
        geometry_of_vectors(oblique, SHAPE, cone=False)
    with refused(ValueError):
        geometry_of_vectors(oblique[:, :9], SHAPE, cone=False)
