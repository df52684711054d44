"""Geometry: selecting, cropping and binning keep every ray at its position."""

from __future__ import annotations

from dataclasses import astuple, fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.base.geometry import Geometry, arrays_of
from recon.base.ray_width import NO_WIDTH, RayWidth
from recon.splatting.problem import binned_geometry
from tests.messages import refused
from tests.recon.trigonometry import pixel_of


def test_a_single_view_is_a_list_of_one_and_none_is_refused() -> None:
    views = Geometry.parallel([0.1, 0.2, 0.3], (2, 2))
    assert views.select(np.array([False, True, False])).angles.tolist() == [0.2]
    with refused(ValueError):
        views.select([])


def test_rows_keep_the_columns() -> None:
    cut = Geometry.parallel([0.0], (10, 7), axis_col=2.5).rows(3, 8)
    assert cut.detector_shape == (5, 7) and cut.axis_col == 2.5
    with refused(ValueError):
        Geometry.parallel([0.0], (10, 7)).rows(3, 12)


def test_angles_cannot_be_changed_from_outside() -> None:
    theta = np.zeros(3)
    geometry = Geometry.parallel(theta, (2, 2))
    theta[0] = 9
    assert geometry.angles[0] == 0
    with refused(ValueError):
        geometry.angles[0] = 1


@given(factor=st.integers(1, 4), axis=st.floats(0, 30), row=st.floats(-3, 20), cone=st.booleans())
def test_binned_pixels_stay_before_the_sample_where_they_were(
    factor: int, axis: float, row: float, cone: bool
) -> None:  # fmt: skip
    how: dict[str, Any] = {"axis_row": row, "shifts": [[1.0, -2.0]]}
    fine = (
        Geometry.cone([0.3], (11, 31), 0.3, 50.0, 70.0, axis_col=axis, **how)
        if cone else Geometry.parallel([0.3], (11, 31), pixel_pitch=0.3, axis_col=axis, **how)
    )  # fmt: skip
    coarse = binned_geometry(fine, factor)
    for point in ((0.0, 0.0, 0.0), (0.7, -0.4, 1.1)):
        # A bin's middle is the middle of its pixels: pixel p of the fine detector is (p - (factor - 1) / 2) / factor.
        expected = (pixel_of(fine, 0, np.array(point)) - (factor - 1) / 2) / factor
        np.testing.assert_allclose(pixel_of(coarse, 0, np.array(point)), expected, atol=1e-9)


@given(start=st.integers(0, 3), factor=st.integers(1, 3), cone=st.booleans())
def test_cutting_and_binning_keep_the_rays_of_a_cone_and_of_leaning_views(start: int, factor: int, cone: bool) -> None:
    lean: dict[str, Any] = {"axis_row": 3.1, "shifts": [[1.0, 2.0]], "roll": 0.2, "tilt": 0.1}
    whole = (
        Geometry.cone([0.3], (9, 12), 0.5, 20.0, 30.0, axis_col=4.2, **lean)
        if cone
        else Geometry.parallel([0.3], (9, 12), pixel_pitch=0.5, axis_col=4.2, **lean)
    )
    binned = whole.rows(start, 9).binned(factor)
    for j in range(binned.detector_shape[0]):
        rows = np.arange(start + j * factor, start + (j + 1) * factor)
        expected = ((rows - whole.origin(0)[1]) * whole.pixel_pitch).mean()
        assert (j - binned.origin(0)[1]) * binned.pixel_pitch == pytest.approx(expected)


def test_views_keep_their_own_shifts_roll_and_tilt() -> None:
    g = Geometry.parallel([0.1, 0.2], (2, 2), shifts=[[0, 1], [2, 3]], roll=[0.0, 0.4], tilt=[0.1, 0.2])
    second = g.select([1])
    assert second.shifts.tolist() == [[2, 3]] and second.roll.tolist() == [0.4] and second.tilt.tolist() == [0.2]
    assert not second.is_straight and Geometry.parallel([0.0], (2, 2), shifts=[[1, 1]]).is_straight
    for name in ("shifts", "roll", "tilt"):
        with pytest.raises(ValueError, match=f"{name} differ"):
            Geometry.parallel([0.1, 0.2], (2, 2), **{name: getattr(g, name)}).at([0.5])
    same = Geometry.parallel([0.1, 0.2], (2, 2), shifts=[[1, 2], [1, 2]], roll=0.3, tilt=0.1).at([0.5, 0.6, 0.7])
    assert same.shifts.tolist() == [[1, 2]] * 3 and same.roll.tolist() == [0.3] * 3 and same.tilt.tolist() == [0.1] * 3
    for bad in ({"shifts": [[0, 1]]}, {"roll": [0.1]}, {"tilt": np.nan}):
        with refused(ValueError):
            Geometry.parallel([0.1, 0.2], (2, 2), **bad)


def test_arrays_hold_all_of_a_geometry() -> None:
    one = Geometry.cone(
        [0.0, 1.0], (4, 6), 0.2, 50, 90, axis_col=2.2, shifts=[(1, 2), (3, 4)], roll=0.1, tilt=[0.2, 0.3]
    )
    for geometry in (
        one.seen_with(RayWidth(1.0, 0.5, 0.01)),
        Geometry.parallel([1.0], (3, 3)).seen_with(NO_WIDTH, 1e-4),
    ):
        found = arrays_of(geometry)
        assert found.keys() == {each.name for each in fields(Geometry)}
        assert all(array.dtype != object for array in found.values())
        np.testing.assert_array_equal(found["width"], astuple(geometry.width))
        np.testing.assert_array_equal(found["angles"], geometry.angles)


def test_a_fan_is_a_cone_of_one_row_in_the_plane_of_the_source() -> None:
    fan = Geometry.fan([0.0, 1.0], 7, 0.5, 20.0, 40.0, axis_col=2.5, shifts=[0.25, -1.0])
    cone = Geometry.cone([0.0, 1.0], (1, 7), 0.5, 20.0, 40.0, axis_col=2.5, shifts=[(0.25, 0.0), (-1.0, 0.0)])
    assert repr(fan) == repr(cone) and fan.axis_row == 0
    np.testing.assert_array_equal(fan.shifts, cone.shifts)
