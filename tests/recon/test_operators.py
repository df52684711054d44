"""The voxel projector against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.geometry import Geometry
from recon.operators import data_residual, project
from recon.volume import Grid, Volume


def _gaussian_case(
    angles: list[float], axis_col: float, pitch: float, centre: tuple[float, float], sigma: float
) -> tuple[Volume, Geometry, np.ndarray]:
    """A Gaussian blob at (x, y) = centre (voxels): its line integrals are a Gaussian in u, sigma sqrt(2π) high."""
    geometry = Geometry.parallel(angles, (3, 48), pitch, axis_col)
    grid = Grid((3, 40, 44), pitch)
    _, y, x = grid.coordinates()
    x0, y0, s = centre[0] * pitch, centre[1] * pitch, sigma * pitch
    blob = np.exp(-((x[None, :] - x0) ** 2 + (y[:, None] - y0) ** 2) / (2 * s * s))
    data = (np.array([1.0, 2.0, 0.0])[:, None, None] * blob).astype(np.float32)
    u = (np.arange(48) - axis_col) * pitch
    shadow = np.stack([np.exp(-((u - x0 * np.cos(t) - y0 * np.sin(t)) ** 2) / (2 * s * s)) for t in angles])
    truth = np.sqrt(2 * np.pi) * s * np.array([1.0, 2.0, 0.0])[None, :, None] * shadow[:, None, :]
    return Volume(data, grid), geometry, truth


@given(
    angle=st.floats(-7, 7),
    axis_col=st.floats(20, 27),
    pitch=st.floats(0.01, 5),
    x0=st.floats(-3, 3),
    y0=st.floats(-3, 3),
)
@settings(max_examples=40, deadline=None)
def test_a_gaussian_projects_to_a_gaussian(angle: float, axis_col: float, pitch: float, x0: float, y0: float) -> None:
    volume, geometry, truth = _gaussian_case([angle], axis_col, pitch, (x0, y0), 4.0)
    # Linear interpolation of a Gaussian errs by at most h²/8 of its second derivative: 1/128 of the peak.
    np.testing.assert_allclose(project(volume, geometry), truth, atol=truth.max() / 120)


def test_a_uniform_box_seen_face_on_is_its_thickness() -> None:
    grid = Grid((1, 10, 20), 0.5)
    volume = Volume(np.full(grid.shape, 2.0, np.float32), grid)
    geometry = Geometry.parallel([0.0, np.pi / 2], (1, 21), 0.5)
    across_y, across_x = project(volume, geometry)[:, 0, 10]
    assert across_y == pytest.approx(2.0 * 10 * 0.5)
    assert across_x == pytest.approx(2.0 * 20 * 0.5, rel=1e-6)


def test_residual_is_zero_for_the_truth_and_one_for_nothing() -> None:
    volume, geometry, _ = _gaussian_case([0.1, 1.0], 23.5, 1.0, (2.0, 1.0), 3.0)
    measured = project(volume, geometry)
    empty = Volume(np.zeros_like(volume.data), volume.grid)
    assert data_residual(volume, measured, geometry) == 0.0
    assert data_residual(empty, measured, geometry) == pytest.approx(1.0)
    half = Volume(volume.data / 2, volume.grid)
    assert data_residual(half, measured, geometry) == pytest.approx(0.5, rel=1e-5)


def test_misfits_are_named() -> None:
    volume, geometry, _ = _gaussian_case([0.1], 23.5, 1.0, (2.0, 1.0), 3.0)
    with pytest.raises(ValueError, match=r"3 slices .* 4 rows"):
        project(volume, Geometry.parallel([0.1], (4, 48)))
    with pytest.raises(ValueError, match="shape"):
        data_residual(volume, np.ones((2, 3, 48), np.float32), geometry)
    with pytest.raises(ValueError, match="all zero"):
        data_residual(volume, np.zeros((1, 3, 48), np.float32), geometry)
