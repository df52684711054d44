"""Enhancement: the box without the can, percentiles, gamma, smoothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from recon.post import enhanced, inscribed_box, rescaled, sample_circle
from tests.recon.post.phantom import CIRCLE, SHAPE, WALL, can
from tests.refused_calls import refused_calls


def test_the_circle_is_that_of_the_can() -> None:
    assert sample_circle(can()) == pytest.approx(CIRCLE, abs=0.75)


def test_the_square_in_the_circle_holds_nothing_of_the_wall() -> None:
    z, y, x = inscribed_box(SHAPE, CIRCLE, margin=0.08)
    assert z == slice(0, SHAPE[0])
    corner = np.hypot(y.start - CIRCLE[0], x.start - CIRCLE[1])
    assert corner < CIRCLE[2] - 3 and can(noise=0)[:, y.start, x.start].max() < WALL / 2


@given(st.floats(5, 40), st.floats(0, 0.45))
def test_the_side_is_2_r_cos_45_less_the_margins(radius: float, margin: float) -> None:
    _, y, x = inscribed_box((3, 200, 200), (100.0, 90.0, radius), margin)
    side = 2 * radius * np.cos(np.pi / 4) * (1 - 2 * margin)
    assert abs((y.stop - y.start) - side) <= 1 and abs((x.stop - x.start) - side) <= 1


def test_percentiles_become_0_and_1(rng: np.random.Generator) -> None:
    volume = rng.normal(3, 2, (10, 20, 30)).astype(np.float32)
    low, high = np.percentile(volume, [2, 98])
    np.testing.assert_allclose(rescaled(volume, 2, 98), np.clip((volume - low) / (high - low), 0, 1), atol=1e-6)


def test_gamma_comes_before_the_filter(rng: np.random.Generator) -> None:
    volume = rng.random((8, 9, 10)).astype(np.float32)
    expected = ndimage.gaussian_filter(rescaled(volume, 0, 100).astype(np.float64) ** 0.5, 1.5)
    np.testing.assert_allclose(enhanced(volume, (0, 100), 0.5, 1.5), expected, atol=1e-5)


test_calls_that_are_refused = refused_calls(__file__, globals())
