"""Geometry and Grid: the convention, and that cutting and binning keep every ray where it was."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.base.geometry import Geometry, arrays_of, geometry_of_arrays
from recon.base.ray_width import NO_WIDTH, RayWidth
from recon.base.volume import Grid, Volume
from recon.splatting.problem import binned_geometry


def test_an_axis_is_never_taken_for_a_pitch() -> None:
    """What a user may leave out has a name: a third number was the pitch, and meant as the axis."""
    given: Any = ([0.0], (4, 96), 47.5)
    with pytest.raises(TypeError, match="positional"):
        Geometry.parallel(*given)
    for cone in ((*given, 50.0, 70.0, 47.5), ([0.0], 96, 0.5, 50.0, 70.0, 47.5)):
        with pytest.raises(TypeError, match="positional"):
            (Geometry.cone if cone[1] == (4, 96) else Geometry.fan)(*cone)


def test_the_axis_is_in_the_middle_unless_told() -> None:
    assert Geometry.parallel([0.0], (4, 10)).axis_col == 4.5
    assert Geometry.parallel([0.0], (4, 10), axis_col=3.2).axis_col == 3.2


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


def test_the_edges_are_half_a_voxel_beyond_the_centres() -> None:
    grid = Grid((3, 4, 5), 0.5, centre=(1.0, 2.0, 3.0))
    low, high = grid.edges
    for axis, centres in zip((2, 1, 0), grid.coordinates(), strict=True):
        assert (low[axis], high[axis]) == pytest.approx((centres[0] - 0.25, centres[-1] + 0.25))


def test_the_field_of_a_centred_axis_is_the_matching_grid() -> None:
    for cols, pitch in ((7, 0.1), (160, 0.0046), (2048, 1.0)):
        views = Geometry.parallel([0.0], (5, cols), pixel_pitch=pitch)
        assert Grid.of_field(views, pitch) == Grid.matching(views)


def test_a_grid_takes_any_list_of_whole_numbers() -> None:
    assert Grid([2, 3, 4], centre=np.zeros(3)) == Grid((2, 3, 4))  # type: ignore[arg-type]
    for arguments, message in (
        ({"shape": (2.5, 3, 4)}, "3 values, each a whole number"),
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


def _edges(geometry: Geometry, view: int) -> np.ndarray:
    """u and z in mm [2, 2] at which the first and last edge of a view's columns and rows see the plane of the axis.

    From where three points of that plane fall, so from nothing but trigonometry: pixels are linear in u and z there.
    """
    c, s = np.cos(geometry.angles[view]), np.sin(geometry.angles[view])
    middle, right, up = (_pixel(geometry, view, np.array(p)) for p in ((0.0, 0.0, 0.0), (c, s, 0.0), (0.0, 0.0, 1.0)))
    rows, cols = geometry.detector_shape
    u = (np.array([-0.5, cols - 0.5]) - middle[0]) / (right - middle)[0]
    z = (np.array([-0.5, rows - 0.5]) - middle[1]) / (up - middle)[1]
    return np.stack((u, z))


moves = st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-30, 30)), min_size=1, max_size=4)


@given(
    rows=st.integers(1, 9), cols=st.integers(1, 40), axis=st.tuples(st.floats(-60, 60), st.floats(-20, 20)),
    pitch=st.floats(1e-3, 1e3), coarser=st.floats(1, 5), shifts=moves, cone=st.booleans(),
)  # fmt: skip
def test_the_field_holds_every_ray_and_no_more(
    rows: int, cols: int, axis: tuple[float, float], pitch: float, coarser: float,
    shifts: list[tuple[float, float]], cone: bool,
) -> None:  # fmt: skip
    shifts = [(col * cols / 2, row) for col, row in shifts]  # farther aside would be wide views
    angles, how = 0.7 * np.arange(len(shifts)), {"axis_row": axis[1], "shifts": shifts}
    if cone:
        views = Geometry.cone(angles, (rows, cols), 2 * pitch, 1000 * pitch, 2000 * pitch, axis_col=axis[0], **how)
    else:
        views = Geometry.parallel(angles, (rows, cols), pixel_pitch=pitch, axis_col=axis[0], **how)
    voxel = pitch * coarser
    (*_, bottom), (x, y, top) = Grid.of_field(views, voxel).edges
    u, z = np.stack([_edges(views, view) for view in range(views.n_views)], axis=1)
    slack = 1e-5 * voxel
    # The plane of the axis turns: what is seen at u is somewhere on the circle of that radius.
    assert x == y and np.abs(u).max() - slack <= x < np.abs(u).max() + voxel / 2 + slack
    assert bottom <= z.min() + slack and z.max() - slack <= top
    assert top - bottom < np.ptp(z) + voxel + slack and top + bottom == pytest.approx(z.min() + z.max(), abs=slack)


def test_shifts_common_to_all_views_equal_a_moved_axis() -> None:
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    moved = Geometry.parallel(angles, (10, 32), axis_col=29.5, axis_row=14.5)
    shifted = Geometry.parallel(angles, (10, 32), shifts=np.tile([14.0, 10.0], (48, 1)))
    assert Grid.of_field(moved, 1.0) == Grid.of_field(shifted, 1.0) == Grid((10, 60, 60), centre=(-10.0, 0, 0))
    beyond = Geometry.parallel(angles, (10, 48), axis_col=-20)
    assert Grid.of_field(beyond, 1.0).shape == (10, 135, 135)  # to 67.5 pixels from the axis


@given(sod=st.floats(3, 60), voxel=st.floats(1, 9), axis=st.floats(0, 40))
def test_the_field_of_a_wide_cone_ends_before_its_source(sod: float, voxel: float, axis: float) -> None:
    views = Geometry.cone([0.0, 2.0], (5, 40), 2.0, sod, 2 * sod, axis_col=axis)
    field = Grid.of_field(views, min(voxel, sod))
    beyond = field.voxel_size / 2  # where voxels are interpolated to zero
    assert np.hypot(*(field.edges[1, :2] + beyond)) < sod or field.shape[1] == 1
    assert field.edges[1, 0] >= min(views.reach, 0.7 * sod - field.voxel_size) * (1 - 1e-9)


def test_a_fit_takes_voxels_like_those_wanted_from_one_to_four_pixels() -> None:
    views = Geometry.cone([0.0], (8, 32), 1.0, 100.0, 200.0)  # pixels of 0.5 mm
    for wanted, edge in ((0.1, 0.5), (0.5, 0.5), (1.2, 1.2), (2.0, 2.0), (32.0, 2.0)):
        assert Grid.for_fit(views, Grid((1, 1, 1), wanted)) == Grid.of_field(views, edge)


@given(factor=st.integers(1, 4), axis=st.floats(0, 30), row=st.floats(-3, 20), cone=st.booleans())
def test_binned_pixels_stay_before_the_sample_where_they_were(
    factor: int, axis: float, row: float, cone: bool
) -> None:  # fmt: skip
    how = {"axis_row": row, "shifts": [[1.0, -2.0]]}
    fine = (
        Geometry.cone([0.3], (11, 31), 0.3, 50.0, 70.0, axis_col=axis, **how)
        if cone else Geometry.parallel([0.3], (11, 31), pixel_pitch=0.3, axis_col=axis, **how)
    )  # fmt: skip
    coarse = binned_geometry(fine, factor)
    for point in ((0.0, 0.0, 0.0), (0.7, -0.4, 1.1)):
        # A bin's middle is the middle of its pixels: pixel p of the fine detector is (p - (factor - 1) / 2) / factor.
        expected = (_pixel(fine, 0, np.array(point)) - (factor - 1) / 2) / factor
        np.testing.assert_allclose(_pixel(coarse, 0, np.array(point)), expected, atol=1e-9)


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
    np.testing.assert_allclose(found, _pixel(geometry, 0, p), atol=1e-9)


def test_the_pixel_of_a_cone_is_smaller_at_the_sample() -> None:
    cone = Geometry.cone([0.0], (4, 8), 0.7, 50.0, 70.0)
    assert cone.sample_pitch == pytest.approx(0.5)
    assert Grid.matching(cone).voxel_size == pytest.approx(0.5)
    with pytest.raises(ValueError, match="0 < sod <= sdd"):
        Geometry.cone([0.0], (4, 8), 0.7, 70.0, 50.0)


@given(start=st.integers(0, 3), factor=st.integers(1, 3), cone=st.booleans())
def test_cutting_and_binning_keep_the_rays_of_a_cone_and_of_leaning_views(start: int, factor: int, cone: bool) -> None:
    lean = {"axis_row": 3.1, "shifts": [[1.0, 2.0]], "roll": 0.2, "tilt": 0.1}
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
        with pytest.raises(ValueError, match="must be finite"):
            Geometry.parallel([0.1, 0.2], (2, 2), **bad)


def test_a_grid_follows_the_height_of_the_axis_row() -> None:
    view = Geometry.parallel([0.0], (5, 8), pixel_pitch=0.5, axis_row=3.0)  # the middle row, 2, is one row below z = 0
    assert Grid.matching(view).centre[0] == pytest.approx(-0.5)
    assert Grid.of_field(view, 0.5).centre[0] == pytest.approx(-0.5)


def test_voxels_may_be_longer_along_z() -> None:
    grid = Grid((4, 6, 6), 0.5, slice_pitch=2.0)
    assert grid.spacing == (2.0, 0.5, 0.5)
    np.testing.assert_allclose(grid.coordinates()[0], [-3, -1, 1, 3])
    np.testing.assert_allclose(grid.edges[:, 2], [-4, 4])
    with pytest.raises(ValueError, match="slice_pitch"):
        Grid((4, 6, 6), 0.5, slice_pitch=0.0)


def test_views_half_a_turn_apart_bring_nothing_new_only_where_they_see_the_same_rays() -> None:
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)

    def parallel(**options: object) -> Geometry:
        return Geometry.parallel(angles, (4, 40), **options)  # type: ignore[arg-type]

    for middle in (parallel(), parallel(axis_col=20.5)):
        assert middle.period == pytest.approx(np.pi)
    beside, moved = parallel(axis_col=2.0), parallel(shifts=np.tile([12.0, 0.0], (12, 1)))
    for other in (beside, moved, parallel(tilt=0.1), Geometry.cone(angles, (4, 40), 1.0, 50.0, 100.0)):
        assert other.period == pytest.approx(2 * np.pi)


def test_arrays_hold_all_of_a_geometry() -> None:
    one = Geometry.cone(
        [0.0, 1.0], (4, 6), 0.2, 50, 90, axis_col=2.2, shifts=[(1, 2), (3, 4)], roll=0.1, tilt=[0.2, 0.3]
    )
    for geometry in (
        one.seen_with(RayWidth(1.0, 0.5, 0.01)),
        Geometry.parallel([1.0], (3, 3)).seen_with(NO_WIDTH, 1e-4),
    ):
        found = geometry_of_arrays(arrays_of(geometry))
        for name, value in arrays_of(found).items():
            np.testing.assert_array_equal(value, arrays_of(geometry)[name])
        assert found.width == geometry.width and all(array.dtype != object for array in arrays_of(found).values())


def test_rows_with_angles_of_their_own_are_of_straight_parallel_views() -> None:
    """However the geometry is made."""
    skewed = Geometry.parallel([0.0, 1.0], (4, 6)).seen_with(NO_WIDTH, 1e-3)
    changes: tuple[dict[str, Any], ...] = (
        {"roll": np.full(2, 0.1)}, {"tilt": np.full(2, 0.1)}, {"sod": 50.0, "sdd": 90.0}, {"skew": np.nan},
    )  # fmt: skip
    for change in changes:
        with pytest.raises(ValueError, match="skew"):
            replace(skewed, **change)


def test_a_fan_is_a_cone_of_one_row_in_the_plane_of_the_source() -> None:
    fan = Geometry.fan([0.0, 1.0], 7, 0.5, 20.0, 40.0, axis_col=2.5, shifts=[0.25, -1.0])
    cone = Geometry.cone([0.0, 1.0], (1, 7), 0.5, 20.0, 40.0, axis_col=2.5, shifts=[(0.25, 0.0), (-1.0, 0.0)])
    assert repr(fan) == repr(cone) and fan.axis_row == 0
    np.testing.assert_array_equal(fan.shifts, cone.shifts)
