"""A large preview is thinned, a small one is not, and light and transmission are what they say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.monitor.check import ScanContext
from beamline.monitor.preview import ENOUGH, edges, thinned, transmission


@given(st.integers(1, 1200), st.integers(1, 1200))
def test_thinning_bounds_the_work_and_leaves_small_previews_whole(rows: int, cols: int) -> None:
    preview = np.broadcast_to(np.float32(0), (rows, cols))
    kept = preview[thinned(preview)].shape
    for n, k in zip((rows, cols), kept, strict=True):
        assert k == n if n < 2 * ENOUGH else ENOUGH <= k <= 2 * ENOUGH
    assert preview[thinned(preview, rows=False)].shape == (rows, kept[1])


def test_light_and_transmission(rng: np.random.Generator) -> None:
    dark, flat = rng.uniform(90, 110, (6, 32)).astype(np.float32), rng.uniform(900, 1100, (6, 32)).astype(np.float32)
    truth = rng.uniform(0.1, 1, (6, 32)).astype(np.float32)
    preview = dark + truth * (flat - dark)
    context = ScanContext(65535, 1000, dark=dark, flat=flat, flat_exposure=0.1)
    found, longer = transmission(preview, context, 0.1), transmission(preview, context, 0.3)
    assert found is not None
    assert longer is not None
    np.testing.assert_allclose(found, truth, rtol=1e-4)
    np.testing.assert_allclose(longer, truth / 3, rtol=1e-4)
    assert edges(truth) == pytest.approx((truth[:, :2].mean(), truth[:, -2:].mean()))
    assert transmission(preview, ScanContext(65535, 1000), 0.1) is None


def test_a_block_without_light_in_the_flat_has_no_transmission() -> None:
    ones = np.ones((2, 2), np.float32)
    context = ScanContext(65535, 1000, dark=ones, flat=np.array([[1, 5], [0, 5]], np.float32), flat_exposure=0.1)
    found = transmission(3 * ones, context, 0.1)
    assert found is not None
    np.testing.assert_array_equal(found, [[np.nan, 0.5], [np.nan, 0.5]])
