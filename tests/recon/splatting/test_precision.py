"""The two precisions, fitted alike, end alike; and the crop is a scan of its own."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.splatting.gaussians import Gaussians
from recon.splatting.precision import compare, small_crop
from recon.splatting.splat import project

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 20, endpoint=False), (10, 60), 0.5, 31.0)


def _blobs(rng: np.random.Generator, n: int = 25) -> Gaussians:
    means = np.column_stack((rng.uniform(-8, 8, (n, 2)), rng.uniform(-2, 2, n)))
    return Gaussians.from_physical(means, rng.uniform(0.8, 2.0, (n, 3)), rng.uniform(0.2, 1, n))


def test_a_fit_in_float32_is_as_good_as_one_in_float64(rng: np.random.Generator) -> None:
    data = project(_blobs(rng), VIEWS).numpy()
    found = compare(data, VIEWS, seed=0, steps=25)
    assert found["residual_float64"] < 0.2
    assert found["residual_float32"] == pytest.approx(found["residual_float64"], rel=0.02)
    assert 0 < found["difference"] < 0.02
    assert found["seconds_float32"] > 0 and found["seconds_float64"] > 0


def test_where_a_cones_detector_stands_does_not_matter(rng: np.random.Generator) -> None:
    """Ten times as far with ten times larger pixels it sees the same: rates are fractions of the field at the axis."""
    turn = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    near, far = (Geometry.cone(turn, (10, 60), 0.5 * m, 100.0, 100.0 * m, 31.0) for m in (1, 10))
    blobs = _blobs(rng)
    found = [compare(project(blobs, cone).numpy(), cone, seed=0, steps=25) for cone in (near, far)]
    assert found[0]["residual_float64"] < 0.2
    assert found[1]["residual_float64"] == pytest.approx(found[0]["residual_float64"], rel=1e-3)


def test_the_crop_shows_the_middle_of_the_scan_in_larger_pixels(rng: np.random.Generator) -> None:
    """Rendering the same Gaussians in the crop's own geometry gives the binned pixels, up to their averaging."""
    gaussians = _blobs(rng)
    data = project(gaussians, VIEWS).numpy()
    small, views = small_crop(data, VIEWS)
    assert small.shape == (12, 5, 30)
    assert (views.n_views, *views.detector_shape) == small.shape
    again = project(gaussians, views).numpy()
    assert np.linalg.norm(again - small) < 0.05 * np.linalg.norm(small)


def test_a_detector_of_one_row_is_not_binned() -> None:
    thin = Geometry.parallel([0.0, 1.0], (1, 200))
    small, views = small_crop(np.ones((2, 1, 200), np.float32), thin)
    assert small.shape == (2, 1, 200) and views.detector_shape == (1, 200)
