"""Geometry and Grid: the convention, and that cutting and binning keep every ray where it was."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.geometry import Geometry
from recon.volume import Grid, Volume


def test_the_axis_is_in_the_middle_unless_told() -> None:
    assert Geometry.parallel([0.0], (4, 10)).axis_col == 4.5
    assert Geometry.parallel([0.0], (4, 10), axis_col=3.2).axis_col == 3.2


@given(factor=st.integers(1, 4), axis=st.floats(0, 30), col=st.integers(0, 6))
def test_a_binned_pixel_sits_at_the_mean_of_its_pixels(factor: int, axis: float, col: int) -> None:
    fine = Geometry.parallel([0.0], (8, 31), pixel_pitch=0.3, axis_col=axis)
    coarse = fine.binned(factor)
    members = np.arange(col * factor, (col + 1) * factor)
    expected = ((members - fine.axis_col) * fine.pixel_pitch).mean()
    assert (col - coarse.axis_col) * coarse.pixel_pitch == pytest.approx(expected, abs=1e-9)
    assert coarse.detector_shape == (8 // factor, 31 // factor)


def test_selected_views_keep_their_order() -> None:
    chosen = Geometry.parallel([0.1, 0.2, 0.3], (2, 2)).select([2, 0])
    assert chosen.angles.tolist() == [0.3, 0.1]


def test_a_single_view_is_a_list_of_one_and_none_is_refused() -> None:
    views = Geometry.parallel([0.1, 0.2, 0.3], (2, 2))
    assert views.select(np.array([False, True, False])).angles.tolist() == [0.2]
    with pytest.raises(ValueError, match="no views"):
        views.select([])


def test_rows_keep_the_columns() -> None:
    cut = Geometry.parallel([0.0], (10, 7), axis_col=2.5).rows(3, 8)
    assert cut.detector_shape == (5, 7) and cut.axis_col == 2.5
    with pytest.raises(ValueError, match="3:12"):
        Geometry.parallel([0.0], (10, 7)).rows(3, 12)


def test_angles_cannot_be_changed_from_outside() -> None:
    theta = np.zeros(3)
    geometry = Geometry.parallel(theta, (2, 2))
    theta[0] = 9
    assert geometry.angles[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        geometry.angles[0] = 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"angles": []}, "non-empty"),
        ({"angles": [0.0, np.nan]}, "not finite"),
        ({"detector_shape": (0, 4)}, "detector_shape"),
        ({"pixel_pitch": -1.0}, "pixel_pitch"),
        ({"axis_col": np.inf}, "axis_col"),
    ],
)
def test_impossible_geometries_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Geometry.parallel(**({"angles": [0.0], "detector_shape": (4, 4)} | arguments))  # type: ignore[arg-type]


def test_voxel_centres_are_symmetric_about_the_grids_centre() -> None:
    z, y, x = Grid((3, 4, 5), 0.5, centre=(1.0, 2.0, 3.0)).coordinates()
    assert (z.mean(), y.mean(), x.mean()) == (1.0, 2.0, 3.0)
    np.testing.assert_allclose(np.diff(x), 0.5)


def test_the_edges_are_half_a_voxel_beyond_the_centres() -> None:
    grid = Grid((3, 4, 5), 0.5, centre=(1.0, 2.0, 3.0))
    low, high = grid.edges
    for axis, centres in zip((2, 1, 0), grid.coordinates(), strict=True):
        assert (low[axis], high[axis]) == pytest.approx((centres[0] - 0.25, centres[-1] + 0.25))


@given(
    rows=st.integers(1, 9), cols=st.integers(1, 40), axis=st.floats(-60, 60), pitch=st.floats(1e-3, 1e3),
    coarser=st.floats(1, 5),
)  # fmt: skip
def test_the_field_holds_every_ray_and_no_more(rows: int, cols: int, axis: float, pitch: float, coarser: float) -> None:
    views = Geometry.parallel([0.0], (rows, cols), pitch, axis)
    field = Grid.of_field(views, pitch * coarser)
    (_, _, low), (x, y, high) = field.edges
    on = min(max(axis, -0.5), cols - 0.5)
    reach = max(on + 0.5, cols - on - 0.5) * pitch
    assert x == y and reach * (1 - 1e-5) <= x < reach + pitch * coarser
    assert -low == high and rows * pitch / 2 * (1 - 1e-5) <= high < rows * pitch / 2 + pitch * coarser


def test_the_field_of_a_centred_axis_is_the_matching_grid() -> None:
    for cols, pitch in ((7, 0.1), (160, 0.0046), (2048, 1.0)):
        views = Geometry.parallel([0.0], (5, cols), pitch)
        assert Grid.of_field(views, pitch) == Grid.matching(views)


def test_a_grid_takes_any_list_of_whole_numbers() -> None:
    assert Grid([2, 3, 4], centre=np.zeros(3)) == Grid((2, 3, 4))  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        Grid((2.5, 3, 4))  # type: ignore[arg-type]
    for arguments, message in (
        ({"shape": (0, 3, 4)}, "shape"), ({"voxel_size": 0.0}, "voxel_size"), ({"centre": (0, np.nan, 0)}, "centre"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            Grid(**({"shape": (2, 3, 4)} | arguments))  # type: ignore[arg-type]


def test_a_volume_fits_its_grid() -> None:
    with pytest.raises(ValueError, match="shape"):
        Volume(np.zeros((2, 2, 2), np.float32), Grid((2, 2, 3)))


def _pixel(geometry: Geometry, view: int, point: np.ndarray) -> np.ndarray:
    """Where a point falls, by the trigonometry of the module's docstring written out without matrices."""
    x, y, z = point
    c, s = np.cos(geometry.angles[view]), np.sin(geometry.angles[view])
    u, v, along = x * c + y * s, z, -x * s + y * c
    t, r = geometry.tilt[view], geometry.roll[view]
    v, along = v * np.cos(t) + along * np.sin(t), along * np.cos(t) - v * np.sin(t)
    u, v = u * np.cos(r) + v * np.sin(r), v * np.cos(r) - u * np.sin(r)
    enlarged = geometry.sdd / (geometry.sod + along) if geometry.is_cone else 1.0
    col, row = geometry.shifts[view]
    return np.array(
        [geometry.axis_col + col + enlarged * u / geometry.pixel_pitch,
         geometry.axis_row + row + enlarged * v / geometry.pixel_pitch]
    )  # fmt: skip


finite = st.floats(-2, 2)


@given(angle=st.floats(-9, 9), roll=finite, tilt=finite, point=st.tuples(finite, finite, finite), cone=st.booleans())
def test_axes_are_a_right_handed_frame_that_puts_points_where_trigonometry_does(
    angle: float, roll: float, tilt: float, point: tuple[float, float, float], cone: bool
) -> None:
    how = {"axis_col": 3.3, "axis_row": 2.2, "shifts": [[0.5, -1.5]], "roll": roll, "tilt": tilt}
    make = (lambda *a, **k: Geometry.cone(*a, 50.0, 70.0, **k)) if cone else Geometry.parallel
    geometry = make([angle], (6, 8), 0.3, **how)
    u, v, d = geometry.axes(0)
    np.testing.assert_allclose(np.stack((u, v, d)) @ np.stack((u, v, d)).T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(u, v), -d, atol=1e-12)
    p = np.array(point)
    enlarged = geometry.sdd / (geometry.sod + d @ p) if cone else 1.0
    found = np.array(geometry.origin(0)) + enlarged * np.array([u @ p, v @ p]) / geometry.pixel_pitch
    np.testing.assert_allclose(found, _pixel(geometry, 0, p), atol=1e-9)


def test_the_pixel_of_a_cone_is_smaller_at_the_sample() -> None:
    cone = Geometry.cone([0.0], (4, 8), 0.7, 50.0, 70.0)
    assert cone.sample_pitch == pytest.approx(0.5)
    assert Grid.matching(cone).voxel_size == pytest.approx(0.5)
    with pytest.raises(ValueError, match="0 < sod <= sdd"):
        Geometry.cone([0.0], (4, 8), 0.7, 70.0, 50.0)


@given(start=st.integers(0, 3), factor=st.integers(1, 3))
def test_cutting_and_binning_keep_the_rays_of_a_cone(start: int, factor: int) -> None:
    whole = Geometry.cone([0.3], (9, 12), 0.5, 20.0, 30.0, 4.2, axis_row=3.1, shifts=[[1.0, 2.0]])
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
    with pytest.raises(ValueError, match="differ from view to view"):
        g.at([0.5])
    for bad in ({"shifts": [[0, 1]]}, {"roll": [0.1]}, {"tilt": np.nan}):
        with pytest.raises(ValueError, match="must be finite"):
            Geometry.parallel([0.1, 0.2], (2, 2), **bad)


def test_a_grid_follows_the_height_of_the_axis_row() -> None:
    view = Geometry.parallel([0.0], (5, 8), 0.5, axis_row=3.0)  # the middle row, 2, is one row below z = 0
    assert Grid.matching(view).centre[0] == pytest.approx(-0.5)
    assert Grid.of_field(view, 0.5).centre[0] == pytest.approx(-0.5)


def test_voxels_may_be_longer_along_z() -> None:
    grid = Grid((4, 6, 6), 0.5, slice_pitch=2.0)
    assert grid.spacing == (2.0, 0.5, 0.5)
    np.testing.assert_allclose(grid.coordinates()[0], [-3, -1, 1, 3])
    np.testing.assert_allclose(grid.edges[:, 2], [-4, 4])
    with pytest.raises(ValueError, match="slice_pitch"):
        Grid((4, 6, 6), 0.5, slice_pitch=0.0)
