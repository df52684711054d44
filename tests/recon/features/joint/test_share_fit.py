"""The smooth share of one of two states: transposes, a known answer, and the fit without it."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.arrays import F32
from recon.base.volume import Grid
from recon.features.joint.proportions import STEPS, fit_share
from recon.features.joint.spectral import Materials, fit_materials
from tests.recon.features.joint.test_spectral import EDGE, rms, views_of

STATES = (0, 1)


def two_grains(side: int = 48, rows: int = 4) -> F32:
    """Fresh and charged [material, z, y, x]: the charge of one grain rises outwards, that of the other is even."""
    y, x = (np.mgrid[:side, :side] - (side - 1) / 2) * 2 / side
    left, right = np.hypot(x + 0.4, y), np.hypot(x - 0.45, y - 0.1)
    charge = np.where(left < 0.35, 0.2 + 0.4 * left / 0.35, 0.8)
    grain = (left < 0.35) | (right < 0.3)
    parts = np.stack([grain * (1 - charge), grain * charge])
    return np.ascontiguousarray(np.repeat(parts[:, None], rows, 1), np.float32)


def charge_error(densities: F32, truth: F32) -> float:
    matter = truth.sum(0) > 0.9
    found = densities[1] / np.maximum(densities.sum(0), 0.05)
    return rms((found - truth[1])[matter])


def test_a_known_share_is_found_in_a_known_sum() -> None:
    """From a wrong share of the right sum, without noise."""
    truth = two_grains()
    views = views_of(truth, 12, EDGE)
    total = truth.sum(0)
    start = Materials(np.stack([total * 0.5, total * 0.5]), Grid.matching(views.geometry), np.zeros(2), 0.0)
    found = fit_share(views, start, STATES)
    assert charge_error(found.densities, truth) < 0.03
    np.testing.assert_allclose(found.densities.sum(0), total, atol=1e-6)
    assert found.densities.min() >= 0


@pytest.mark.slow
def test_noise_is_less_than_of_the_fit_alone() -> None:
    fine = np.repeat(np.repeat(two_grains(64), 2, 2), 2, 3)
    truth = fine.reshape(2, 4, 64, 2, 64, 2).mean((3, 5))
    views = views_of(fine, 10, EDGE, noise=0.06, fine=2)
    alone = fit_materials(views)
    smooth = fit_share(views, alone, STATES)
    assert charge_error(smooth.densities, truth) < 0.8 * charge_error(alone.densities, truth)


def test_an_end_keeps_the_densities_found_before() -> None:
    truth = two_grains(24)
    views = views_of(truth, 6, EDGE)
    start = Materials(truth, Grid.matching(views.geometry), np.zeros(2), 0.0)
    heard: list[int] = []

    def go_on(left: int) -> bool:
        heard.append(left)
        return len(heard) < 5

    assert fit_share(views, start, STATES, go_on) is start
    assert heard == [STEPS - n for n in range(1, 6)]
    assert fit_share(views, start, STATES, stop=lambda: True) is start


@pytest.mark.parametrize("states", [(0, 0), (0, 2), (-1, 0)])
def test_states_that_are_no_two_materials_are_refused(states: tuple[int, int]) -> None:
    truth = two_grains(16)
    views = views_of(truth, 3, EDGE)
    with pytest.raises(ValueError, match=r"two different materials from 0 to 1"):
        fit_share(views, Materials(truth, Grid.matching(views.geometry), np.zeros(2), 0.0), states)
