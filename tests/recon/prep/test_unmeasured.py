"""Pixels without data: moved in, not finite, or an object that comes and goes; the sample itself is kept."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from recon.base.arrays import Mask
from recon.prep.correct import Plan, apply
from recon.prep.counts_plan import CorrectionSettings, survey
from recon.prep.references import References
from recon.prep.unmeasured import foreign_rows, runs_of, unmeasured, with_borders_filled, with_rim

SHAPE, VIEWS = (20, 64), 32
ANGLES = np.linspace(0, np.pi, VIEWS, endpoint=False)
NOTHING = np.zeros(SHAPE, np.bool_)
COLS = np.arange(64) - 31.5


def views_of(body: np.ndarray, photons: float = 1e4, seed: int = 0) -> np.ndarray:
    """Transmission [view, row, col] of line integrals [view, col] with the noise of photons and of the readout."""
    rng = np.random.default_rng(seed)
    lines = np.repeat(body[:, None], SHAPE[0], axis=1)
    return ((rng.poisson(photons * np.exp(-lines)) + rng.normal(0, 5, lines.shape)) / photons).astype(np.float32)


def disc(radius: float, density: float, away: float = 0.0) -> np.ndarray:
    """Line integrals [view, col] of a disc, so many columns beside the axis."""
    apart = COLS - away * np.cos(ANGLES + 0.4)[:, None]
    return 2 * density * np.sqrt(np.maximum(radius**2 - apart**2, 0))


SAMPLE = disc(22, 0.03)


@pytest.mark.parametrize("width", [1, 9, 21])
@pytest.mark.parametrize(("shift", "rim"), [(0.0, 0), (0.4, 1)])
def test_a_border_of_one_value_is_found_with_what_interpolation_mixed(width: int, shift: float, rim: int) -> None:
    counts = np.random.default_rng(0).poisson(1e4, SHAPE) + 100.0
    counts[:, :width] = 0
    counts[:, width] *= 1 - shift  # a pixel between both
    light = ((counts - 100) / 1e4).astype(np.float32)
    mask = unmeasured(counts, light, NOTHING, None)
    assert mask is not None and mask[:, : width + rim].all() and not mask[:, width + rim :].any()
    assert runs_of(mask, 7).tolist() == [[7, row, 0, width + rim] for row in range(SHAPE[0])]
    assert with_borders_filled(counts)[:, :width].min() > 5000


@pytest.mark.parametrize("photons", [100.0, 1e4])
@pytest.mark.parametrize(("blur", "rim"), [(0.01, 0), (0.6, 1)])
def test_a_rim_is_as_wide_as_the_blur_of_an_edge(photons: float, blur: float, rim: int) -> None:
    """Rows of a sample that changes from row to row, some of them not read."""
    depth = 0.5 + 0.03 * np.arange(SHAPE[0])[:, None] + SAMPLE[:1]
    light = np.exp(-depth) * (np.abs(np.arange(SHAPE[0]) - 9) > 2)[:, None]
    light = np.random.default_rng(0).poisson(photons * gaussian_filter1d(light, blur, axis=0)) / photons
    away = np.abs(np.arange(SHAPE[0]) - 9)
    dark, expected = (np.repeat(away[:, None] <= reach, SHAPE[1], axis=1) for reach in (2, 2 + rim))
    np.testing.assert_array_equal(with_rim(dark, light.astype(np.float32)), expected)


def test_a_turn_of_the_image_leaves_corners() -> None:
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]]
    corner = row + 4 * (SHAPE[1] - 1 - col) < 12
    light = np.where(corner, -0.01, np.random.default_rng(0).normal(1, 0.01, SHAPE)).astype(np.float32)
    mask = unmeasured(light, light, NOTHING, None)
    assert mask is not None and mask[corner].all() and mask.mean() < 3 * corner.mean()


def test_areas_that_are_not_finite_are_unmeasured_and_single_pixels_are_not() -> None:
    light = np.ones(SHAPE, np.float32)
    light[8:12, 30:34] = light[3, 5] = np.nan
    mask = unmeasured(light, light, NOTHING, None)
    assert mask is not None and mask.sum() == 16 and mask[8:12, 30:34].all()


def with_post(width: float) -> tuple[np.ndarray, Mask]:
    """Views of the sample with an opaque post that passes through the beam, and where it is [view, col]."""
    post = np.abs(COLS - 60 * np.cos(ANGLES + 0.3)[:, None]) < width / 2
    return views_of(SAMPLE + 50.0 * post), post


@pytest.mark.parametrize("width", [3, 8, 20])
def test_a_post_that_comes_and_goes_is_no_sample(width: int) -> None:
    light, post = with_post(width)
    foreign = foreign_rows(light, ANGLES)
    assert foreign.all()
    for view, columns in zip(light, post, strict=True):
        mask = unmeasured(view, view, NOTHING, foreign)
        if columns.any():
            assert mask is not None and mask[:, columns].all() and mask[0].sum() <= columns.sum() + 4
        else:
            assert mask is None


FOIL = np.abs(np.sin(ANGLES - 1.0))[:, None] * 30 / 2 + 1.0  # half the width of the shadow of a foil 30 long, 2 thick
BODIES = {
    "pin in the middle": SAMPLE + disc(3, 2.0),
    "pin beside the axis": SAMPLE + disc(3, 2.0, 15),
    "foil seen edge-on": SAMPLE + np.where(np.abs(COLS) < FOIL, 0.2 * 60 / (2 * FOIL), 0),
    "no metal": SAMPLE,
}


@pytest.mark.parametrize("name", BODIES)
def test_what_the_sample_absorbs_is_measured(name: str) -> None:
    light = views_of(BODIES[name])
    foreign = foreign_rows(light, ANGLES)
    assert not foreign.any()
    assert (light.min() < 0.01) == (name != "no metal")
    assert all(unmeasured(view, view, NOTHING, foreign) is None for view in light)


def test_batches_and_all_at_once_agree_to_the_bit() -> None:
    light, _ = with_post(8)
    dark, flat = np.full(SHAPE, 100, np.float32), np.full(SHAPE, 1e4 + 100, np.float32)
    counts, at = light * 1e4 + 100, np.arange(VIEWS, dtype=float)

    plan: Plan = survey(References(dark, ((0.0, flat),)), CorrectionSettings(air="none"), foreign=np.ones(20, bool))
    all_of_them, _ = apply(counts, at, plan, np.arange(VIEWS))
    parts = []
    for first in range(0, VIEWS, 5):
        part = slice(first, first + 5)
        lines, plan = apply(counts[part], at[part], plan, np.arange(VIEWS)[part], last=part.stop >= VIEWS)
        parts.append(lines)
    np.testing.assert_array_equal(np.concatenate([part.data for part in parts]), all_of_them.data)
    np.testing.assert_array_equal(np.concatenate([part.unmeasured for part in parts]), all_of_them.unmeasured)
    assert all_of_them.floored == 0 and all_of_them.unmeasured.size
