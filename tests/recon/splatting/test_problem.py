"""The data of a fit: units, weights, noise, binned pixels, later projections."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from recon.base.kernel import Truncation
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.splatting.backend import Cpu
from recon.splatting.gaussians import Gaussians
from recon.splatting.problem import extend, join_pixels, make_problem
from recon.splatting.splat import project
from tests.messages import refused

VIEWS = Geometry.parallel([0.0, 0.9, 2.0], (12, 18), pixel_pitch=0.5)
GRID = Grid.matching(VIEWS)


def test_images_times_scale_are_the_projections(rng: np.random.Generator) -> None:
    data = rng.random((3, 12, 18)).astype(np.float32)
    problem = make_problem(Views(data, VIEWS), GRID, 0.3, Cpu())
    assert problem.half_field == pytest.approx(4.5)
    np.testing.assert_allclose(problem.projections, data, rtol=1e-6)
    later = extend(problem, data[:1], np.array([1.3]))
    assert later.geometry.n_views == 4 and later.images[0] is problem.images[0]


def test_line_integrals_below_zero_weigh_as_air_does(rng: np.random.Generator) -> None:
    data = rng.uniform(0.2, 1.5, (3, 12, 18)).astype(np.float32)
    data[0, ::3, ::4] = -3
    likely, squares = (
        make_problem(Views(data, VIEWS), GRID, 0.1, Cpu(), loss=k, ssim_weight=0) for k in ("poisson", "l2")
    )
    slopes = []
    for problem in (likely, squares):
        image = problem.images[0] + np.float32(0.4)
        slopes.append(np.array(problem.loss(image, problem.images[0], problem.target_maps[0])[1]))
    np.testing.assert_allclose(slopes[0], np.exp(-np.maximum(data[0], 0)) * slopes[1], rtol=1e-4)


def test_weights_follow_their_pixels(rng: np.random.Generator) -> None:
    data = rng.random((3, 12, 18)).astype(np.float32)
    data[1, 2:4, 4:6] = np.nan
    problem = make_problem(Views(data, VIEWS), GRID, 1.0, Cpu())
    assert problem.weights[0] is None and problem.weights[1] is not None
    expected = np.ones((12, 18))
    expected[2:4, 4:6] = 0
    np.testing.assert_array_equal(problem.weights[1], expected)


@pytest.mark.parametrize("value", [1e7, -1e7, 1e12, 3e38, -3e38])
@pytest.mark.parametrize("unit", [1e-6, 0.3, 1e6])
def test_values_that_no_matter_explains_weigh_nothing_and_spread_nowhere(
    rng: np.random.Generator, value: float, unit: float
) -> None:
    scale = 4.5 * unit  # half field (mm) times density unit
    data = (scale * rng.random((3, 12, 18))).astype(np.float32)
    spoilt, absent = data.copy(), data.copy()
    at = np.s_[1, 3:5, 4:9]
    spoilt[at] = np.clip(value * scale, -3e38, 3e38)
    absent[at] = np.nan
    wild, expected = (make_problem(Views(d, VIEWS), GRID, unit, Cpu(), ssim_weight=0.25) for d in (spoilt, absent))
    image = rng.random((12, 18)).astype(np.float32)
    assert [w is None for w in wild.weights] == [True, False, True]
    measured = wild.weights[1]
    assert measured is not None and not measured[at[1:]].any() and measured.sum() == 12 * 18 - 10
    for view in range(3):
        # Not only is nothing NaN: it is the very problem in which nothing was measured there.
        np.testing.assert_array_equal(wild.images[view], expected.images[view])
        assert np.isfinite(wild.images[view]).all()
        assert all(np.isfinite(part).all() for part in wild.target_maps[view])
        loss, slope = wild.loss(image, wild.images[view], wild.target_maps[view], wild.weights[view])
        assert np.isfinite(float(loss)) and np.isfinite(slope).all()
        if view == 1:
            assert not slope[at[1:]].any() and slope.any()
        assert 0 < float(Cpu().misfit(image, wild.images[view], wild.weights[view])) < 10
    assert np.isfinite(wild.projections).all()


def test_what_is_large_but_can_be_squared_keeps_its_weight(rng: np.random.Generator) -> None:
    data = rng.random((3, 12, 18)).astype(np.float32)
    data[0, 5, 5] = 0.99e6 * 4.5
    problem = make_problem(Views(data, VIEWS), GRID, 1.0, Cpu())
    assert problem.weights == (None, None, None)
    loss, slope = problem.loss(problem.images[1], problem.images[0], problem.target_maps[0], None)
    assert np.isfinite(float(loss)) and np.isfinite(slope).all()


@given(seed=st.integers(0, 1000), share=st.floats(0, 0.9), factor=st.sampled_from([2, 3]))
def test_masked_pixels_have_no_part_in_joined_ones(seed: int, share: float, factor: int) -> None:
    rng = np.random.default_rng(seed)
    data = rng.uniform(0.5, 1.5, (3, 12, 18)).astype(np.float32)
    weights = rng.uniform(0.1, 2, data.shape).astype(np.float32)
    weights[rng.random(data.shape) < share] = 0
    weights[:, 0, 0] = 1  # no view is blind
    joined = join_pixels(Views(data, VIEWS, weights), factor)
    found, kept, views = joined.data, joined.weights, joined.geometry
    rows, cols = 12 // factor, 18 // factor
    assert kept is not None and found.shape == kept.shape == (3, rows, cols) == (3, *views.detector_shape)
    for view, row, col in np.ndindex(3, rows, cols):
        cell = np.s_[view, row * factor : (row + 1) * factor, col * factor : (col + 1) * factor]
        p, w = data[cell].astype(np.float64), weights[cell].astype(np.float64)
        assert kept[view, row, col] == pytest.approx(w.mean(), rel=1e-5)
        expected = (w * p).sum() / w.sum() if w.any() else 0
        assert found[view, row, col] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("beam", ["parallel", "cone"])
@pytest.mark.parametrize("factor", [2, 3, 4, 8])
def test_the_sample_stays_in_place_behind_binned_pixels(beam: str, factor: int) -> None:
    # 23 rows and 37 columns are a multiple of no factor, and the axis is in the middle of neither.
    width, cut = 9.0, Truncation(9.0, 1e-12)  # of the Gaussians, in pixels
    how: dict[str, Any] = {"axis_col": 15.3, "axis_row": 9.6, "shifts": [[0, 0], [1.5, -0.7], [0, 0]]}
    views = (
        Geometry.parallel(VIEWS.angles, (23, 37), pixel_pitch=0.5, **how)
        if beam == "parallel" else Geometry.cone(VIEWS.angles, (23, 37), 1.0, 200.0, 400.0, **how)
    )  # fmt: skip
    means = np.array([[1.0, -2.0, 3.0], [-2.0, 1.0, -4.0], [3.0, 2.0, 1.0]])
    model = Gaussians.from_physical(means, np.full((3, 3), 0.5 * width), np.full(3, 0.2))
    fine = project(model, views, truncation=cut).numpy()
    joined = join_pixels(Views(fine, views), factor)
    binned, rough = joined.data, joined.geometry
    off = np.abs(project(model, rough, truncation=cut).numpy() - binned).max() / fine.max()
    # A mean over a pixel differs from the value in its middle by factor² / 24 times the second derivatives, of which
    # there are two, each at most 1 / width². Half a pixel off would be 0.6 * 0.5 / width, for factor 2 five times that.
    assert off < factor**2 / 12 / width**2 * 1.1


def test_a_detector_too_small_to_be_binned_is_told_by_name() -> None:
    one = Geometry.parallel(VIEWS.angles, (1, 18), pixel_pitch=0.5)
    with refused(ValueError):
        join_pixels(Views(np.ones((3, 1, 18), np.float32), one), 2)


def test_later_views_have_the_shift_roll_and_tilt_of_the_others_or_are_refused(rng: np.random.Generator) -> None:
    data = rng.random((3, 12, 18)).astype(np.float32)
    same = {"shifts": [[1.0, 2.0]] * 3, "roll": 0.1, "tilt": 0.2}
    leaning = Geometry.parallel(VIEWS.angles, (12, 18), pixel_pitch=0.5, **same)  # type: ignore[arg-type]
    later = extend(make_problem(Views(data, leaning), GRID, 0.3, Cpu()), data[:1], np.array([1.3])).geometry
    assert later.shifts.tolist() == [[1.0, 2.0]] * 4
    assert later.roll.tolist() == [0.1] * 4 and later.tilt.tolist() == [0.2] * 4
    shifted = Geometry.parallel(VIEWS.angles, (12, 18), pixel_pitch=0.5, shifts=[[0, 0], [1, 0], [0, 0]])
    with refused(ValueError):
        extend(make_problem(Views(data, shifted), GRID, 0.3, Cpu()), data[:1], np.array([1.3]))


def test_a_view_with_only_wild_values_is_refused_with_the_range(rng: np.random.Generator) -> None:
    data = rng.random((3, 12, 18)).astype(np.float32)
    data[1] = 1e8
    with refused(ValueError):
        make_problem(Views(data, VIEWS), GRID, 1.0, Cpu())


def test_what_makes_no_problem_is_refused(rng: np.random.Generator) -> None:
    data = rng.random((3, 12, 18)).astype(np.float32)
    with refused(ValueError):
        make_problem(Views(data[:2], VIEWS), GRID, 1.0, Cpu())
    with refused(ValueError):
        make_problem(Views(data, VIEWS), GRID, 1.0, Cpu(), loss="huber")  # type: ignore[arg-type]
