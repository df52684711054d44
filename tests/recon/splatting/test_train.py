"""The scale of weights in a fit."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.masks import usual_weight

RNG = np.random.default_rng(0)
DATA = np.maximum(RNG.normal(0.2, 0.5, (4, 12, 30)), 0).astype(np.float32)
WEIGHTS = RNG.uniform(0.1, 2, DATA.shape).astype(np.float32)


def test_rays_past_the_sample_do_not_set_the_scale_of_weights() -> None:
    assert usual_weight(np.where(DATA > 0, WEIGHTS, 100), DATA) == pytest.approx(usual_weight(WEIGHTS, DATA), rel=1e-6)


def test_the_scale_of_weights_follows_their_unit() -> None:
    assert usual_weight(8 * WEIGHTS, DATA) == pytest.approx(8 * usual_weight(WEIGHTS, DATA), rel=1e-6)


def test_masks_have_the_scale_one() -> None:
    mask = (WEIGHTS > 1).astype(np.float32)
    assert usual_weight(mask, DATA) == 1 and usual_weight(mask, np.zeros_like(DATA)) == 1


def test_one_wild_ray_does_not_set_the_scale_of_weights() -> None:
    wild = DATA.copy()
    wild[0, 0, 0] = 1e9
    assert usual_weight(WEIGHTS, wild) == pytest.approx(usual_weight(WEIGHTS, DATA), rel=0.02)
