"""Moments of exact projections of balls show the axis, heights and angles of the scan, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from recon.prep.moments import moments_of
from tests.recon.prep.balls import Balls

ANGLES = np.linspace(0, np.pi, 45, endpoint=False)
SHAPE, AXIS = (24, 72), 36.8


def noisy(views: np.ndarray, sigma: float = 0.01) -> np.ndarray:
    return (views + np.random.default_rng(3).normal(0, sigma, views.shape)).astype(np.float32)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("stretch", [0.95, 1.0, 1.05])
def test_angles_of_another_scale(seed: int, stretch: float) -> None:
    views = Balls(ANGLES * stretch, SHAPE, AXIS, seed=seed).views()
    shown = moments_of(noisy(views), ANGLES, AXIS)
    assert abs(shown.stretch - (stretch - 1)) < 4 * shown.stretch_sigma
    if seed != 1:  # of that sample the two fits disagree by as much as angles that are wrong by 3 %
        assert 0.8 < (shown.stretch + 1e-9) / (stretch - 1) < 1.2 if stretch != 1 else abs(shown.stretch) < 0.005
        assert shown.stretch_sigma < 0.01
    if stretch == 1:
        assert shown.axis_col == pytest.approx(AXIS, abs=0.1)
        assert np.ptp(shown.row_shift) < 8 * shown.row_shift_sigma


def test_heights_of_views() -> None:
    """Balls that sink by a row: as views of the whole stack, cut at other rows and between them."""
    high = Balls(ANGLES, (4 * SHAPE[0] + 16, SHAPE[1]), AXIS).views()[:, ::2] / 2  # half rows: balls are flat
    sinks = np.round(np.linspace(0, 2, ANGLES.size)).astype(int)
    views = np.stack([view[8 - sink : 8 - sink + 2 * SHAPE[0] : 2] for view, sink in zip(high, sinks, strict=True)])
    shown = moments_of(noisy(views), ANGLES, AXIS)
    expected = sinks / 2 - (sinks / 2).mean()
    np.testing.assert_allclose(shown.row_shift, expected, atol=0.25)


def test_what_few_rows_and_views_do_not_tell() -> None:
    views = noisy(Balls(ANGLES, SHAPE, AXIS).views())
    shown = moments_of(views[:3, :4], ANGLES[:3], AXIS)
    assert np.isnan([shown.axis_col, shown.stretch, *shown.row_shift]).all()
    assert np.isnan(moments_of(np.zeros_like(views), ANGLES, AXIS).stretch)


def test_a_body_of_revolution_says_nothing_of_angles() -> None:
    """Its views are one view to the last bit: what tells angles is rounding."""
    view = np.sqrt(np.clip(20.0**2 - (np.arange(SHAPE[1]) - AXIS) ** 2, 0, None))
    views = np.broadcast_to(view, (ANGLES.size, *SHAPE)).astype(np.float32)
    assert moments_of(views, ANGLES, AXIS).stretch_sigma > 1
