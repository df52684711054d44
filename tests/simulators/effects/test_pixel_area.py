"""Pixel area: a frame is that of finer pixels, joined."""

from __future__ import annotations

import numpy as np
import pytest

from simulators.effects.pixel_area import PixelArea
from simulators.frame.detector import Detector
from tests.simulators import shots

HARDENING = {"kind": "beam_hardening", "weights": [1.0, 1.0], "ratios": [1.0, 2.0]}


@pytest.mark.parametrize("rays", [2, 3, 4])
@pytest.mark.parametrize("others", [(), (HARDENING,)])
def test_a_pixel_counts_what_finer_pixels_count_on_average(rays: int, others: tuple[dict[str, object], ...]) -> None:
    wide = shots.frame(shots.scene({"kind": "pixel_area", "rays": rays}, *others))
    fine = shots.shot(detector=Detector.centred((60 * rays, 80 * rays), 0.01 / rays))
    joined = shots.frame(shots.scene(*others), fine).reshape(60, rays, 80, rays).mean(axis=(1, 3))
    np.testing.assert_allclose(wide, joined, atol=1.0)  # of counts up to 8700, each rounded
    middle = shots.frame(shots.scene(*others))
    assert np.abs(middle.astype(float) - joined).max() > 200  # at edges


def test_the_open_beam_stays_as_it_is() -> None:
    np.testing.assert_array_equal(
        shots.frame(shots.scene("pixel_area"), sample=False), shots.frame(shots.scene(), sample=False)
    )


def test_rays_are_evenly_spread_about_the_middle() -> None:
    offsets = np.array(PixelArea(4).offsets)
    np.testing.assert_allclose(offsets.mean(axis=0), 0, atol=1e-15)
    assert sorted(set(offsets[:, 0])) == [-0.375, -0.125, 0.125, 0.375] and len(offsets) == 16
