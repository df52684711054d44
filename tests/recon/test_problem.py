"""The data of a fit: units, weights, noise, joined pixels, views that come later."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.backend import Cpu
from recon.geometry import Geometry
from recon.problem import coarser, extend, make_problem, noise_level
from recon.volume import Grid

VIEWS = Geometry.parallel([0.0, 0.9, 2.0], (12, 18), 0.5)
GRID = Grid.matching(VIEWS)


@given(sigma=st.floats(1e-4, 10), seed=st.integers(0, 5))
def test_the_noise_level_is_that_of_white_noise_on_smooth_views(sigma: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    col = np.linspace(-1, 1, 200)
    smooth = sigma * 100 * np.sqrt(1 - 0.9 * col**2)
    views = (smooth + rng.normal(0, sigma, (4, 40, 200))).astype(np.float32)
    # 32000 second differences: the median's standard error is below one percent.
    assert noise_level(views) == pytest.approx(sigma, rel=0.06)


def test_images_times_scale_are_the_projections(rng: np.random.Generator) -> None:
    data = rng.random((3, 12, 18)).astype(np.float32)
    problem = make_problem(data, VIEWS, GRID, 0.3, Cpu())
    assert problem.half_field == pytest.approx(4.5)
    np.testing.assert_allclose(problem.projections, data, rtol=1e-6)
    later = extend(problem, data[:1], np.array([1.3]))
    assert later.geometry.n_views == 4 and later.images[0] is problem.images[0]


def test_weights_follow_their_pixels(rng: np.random.Generator) -> None:
    data = rng.random((3, 12, 18)).astype(np.float32)
    data[1, 2:4, 4:6] = np.nan
    problem = make_problem(data, VIEWS, GRID, 1.0, Cpu())
    assert problem.weights[0] is None and problem.weights[1] is not None
    expected = np.ones((12, 18))
    expected[2:4, 4:6] = 0
    np.testing.assert_array_equal(problem.weights[1], expected)
    joined = coarser(problem, 2, "l1", 0.25)
    assert joined.geometry.detector_shape == (6, 9) and joined.weights[1][1, 2] == 0
    np.testing.assert_allclose(
        joined.projections[0], data[0].reshape(6, 2, 9, 2).mean(axis=(1, 3)), rtol=1e-5
    )  # fmt: skip


def test_what_makes_no_problem_is_refused(rng: np.random.Generator) -> None:
    data = rng.random((3, 12, 18)).astype(np.float32)
    with pytest.raises(ValueError, match="shape"):
        make_problem(data[:2], VIEWS, GRID, 1.0, Cpu())
    with pytest.raises(ValueError, match="loss must be"):
        make_problem(data, VIEWS, GRID, 1.0, Cpu(), loss="huber")  # type: ignore[arg-type]
