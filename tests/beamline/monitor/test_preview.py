"""A large preview is thinned, a small one is not."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from beamline.monitor.preview import ENOUGH, thinned


@given(st.integers(1, 1200), st.integers(1, 1200))
def test_thinning_bounds_the_work_and_leaves_small_previews_whole(rows: int, cols: int) -> None:
    preview = np.broadcast_to(np.float32(0), (rows, cols))
    kept = preview[thinned(preview)].shape
    for n, k in zip((rows, cols), kept, strict=True):
        assert k == n if n < 2 * ENOUGH else ENOUGH <= k <= 2 * ENOUGH
    assert preview[thinned(preview, rows=False)].shape == (rows, kept[1])
