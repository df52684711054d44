"""Rays of projections: the sign convention, and the field of view."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from recon.base.ray_width import NO_WIDTH
from recon.base.volume import Grid
from tests.recon.trigonometry import pixel_of

finite = st.floats(-2, 2)


@given(angle=st.floats(-9, 9), roll=finite, tilt=finite, point=st.tuples(finite, finite, finite), cone=st.booleans())
def test_axes_are_a_right_handed_frame_that_puts_points_where_trigonometry_does(
    angle: float, roll: float, tilt: float, point: tuple[float, float, float], cone: bool
) -> None:
    how: Any = {"axis_col": 3.3, "axis_row": 2.2, "shifts": [[0.5, -1.5]], "roll": roll, "tilt": tilt}
    distances = {"sod": 50.0, "sdd": 70.0} if cone else {}
    geometry = (Geometry.cone if cone else Geometry.parallel)([angle], (6, 8), pixel_pitch=0.3, **distances, **how)
    u, v, d = geometry.axes(0)
    np.testing.assert_allclose(np.stack((u, v, d)) @ np.stack((u, v, d)).T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(u, v), -d, atol=1e-12)
    p = np.array(point)
    enlarged = geometry.sdd / (geometry.sod + d @ p) if cone else 1.0
    found = np.array(geometry.origin(0)) + enlarged * np.array([u @ p, v @ p]) / geometry.pixel_pitch
    np.testing.assert_allclose(found, pixel_of(geometry, 0, p), atol=1e-9)


def test_the_pixel_of_a_cone_is_smaller_at_the_sample() -> None:
    cone = Geometry.cone([0.0], (4, 8), 0.7, 50.0, 70.0)
    assert cone.sample_pitch == pytest.approx(0.5)
    assert Grid.matching(cone).voxel_size == pytest.approx(0.5)
    with pytest.raises(ValueError, match="0 < sod <= sdd"):
        Geometry.cone([0.0], (4, 8), 0.7, 70.0, 50.0)


def test_views_half_a_turn_apart_bring_nothing_new_only_where_they_see_the_same_rays() -> None:
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)

    def parallel(**options: object) -> Geometry:
        return Geometry.parallel(angles, (4, 40), **options)  # type: ignore[arg-type]

    for middle in (parallel(), parallel(axis_col=20.5)):
        assert middle.period == pytest.approx(np.pi)
    beside, moved = parallel(axis_col=2.0), parallel(shifts=np.tile([12.0, 0.0], (12, 1)))
    for other in (beside, moved, parallel(tilt=0.1), Geometry.cone(angles, (4, 40), 1.0, 50.0, 100.0)):
        assert other.period == pytest.approx(2 * np.pi)


def test_rows_with_angles_of_their_own_are_of_straight_parallel_views() -> None:
    """However the geometry is made."""
    skewed = Geometry.parallel([0.0, 1.0], (4, 6)).seen_with(NO_WIDTH, 1e-3)
    changes: tuple[dict[str, Any], ...] = (
        {"roll": np.full(2, 0.1)}, {"tilt": np.full(2, 0.1)}, {"sod": 50.0, "sdd": 90.0}, {"skew": np.nan},
    )  # fmt: skip
    for change in changes:
        with pytest.raises(ValueError, match="skew"):
            replace(skewed, **change)
