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
