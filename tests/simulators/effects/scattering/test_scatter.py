"""Scatter: how much is added, where, and none of it where there is no sample."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from simulators.effects.scattering.scatter import Scatter
from simulators.frame import sensor
from tests.simulators import shots

CONVERSION = sensor.CONVERSION["standard"]


def test_an_even_floor_is_a_share_of_the_mean_that_the_sample_lets_through() -> None:
    scene = shots.scene({"kind": "scatter", "ratio": 0.1})
    primary = np.exp(-shots.depth(scene, 0.4))
    seen = shots.frame(scene) * CONVERSION / 4000
    np.testing.assert_allclose(seen, primary + 0.1 * primary.mean(), atol=2e-5)
    assert (shots.frame(scene, sample=False) == round(4000 / CONVERSION)).all()


def test_a_background_is_there_with_and_without_the_sample_and_grows_with_exposure_and_binning() -> None:
    effect = Scatter(background=8e3)
    for sample in (True, False):
        added = effect.apply(np.zeros((60, 80)), shots.shot(sample=sample))
        np.testing.assert_allclose(added, 80.0)  # 8000/s x 10 ms
    added = effect.apply(np.zeros((30, 40)), shots.shot(exposure=0.03, binning=2))
    np.testing.assert_allclose(added, 8e3 * 0.03 * 4)


@pytest.mark.parametrize(("width_mm", "small"), [(0.03, 3.0), (0.1, 5.0), (0.3, 7.5)])
def test_a_broad_blur_keeps_the_mean_and_is_the_gaussian(width_mm: float, small: float) -> None:
    """Against scipy's sampled Gaussian on the full image; pixels of 10 um. `small` is the width in pixels of the image
    on which it is worked out: its square says how close (see the tests of broad_blur)."""
    primary = np.exp(-shots.depth(shots.scene(), 0.4))
    added = Scatter(ratio=0.2, width_mm=width_mm).apply(primary.copy(), shots.shot()) - primary
    assert added.mean() == pytest.approx(0.2 * primary.mean(), rel=1e-12)
    expected = gaussian_filter(primary, width_mm / 0.01, mode="reflect", truncate=8)
    np.testing.assert_allclose(added / 0.2, expected, atol=0.2 / small**2)
