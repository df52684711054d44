"""Reading pixels: in batches, in bins of finite values, and flats and darks between projections."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.projections.preparation import Preparation
from beamline.projections.read import read_binned
from beamline.projections.references import read_references
from beamline.projections.selection import Selection
from beamline.projections.views import select
from tests.beamline.array_source import ArraySource


@pytest.mark.parametrize("binning", [1, 2])
def test_rows_of_all_frames_are_read_where_the_pieces_of_a_frame_are_too_many_to_hold(
    monkeypatch: pytest.MonkeyPatch, binning: int
) -> None:
    data = np.arange(5 * 8 * 4, dtype=np.uint16).reshape(5, 8, 4)
    source, plain = ArraySource(data, [0] * 5, np.zeros(5)), ArraySource(data, [0] * 5, np.zeros(5))
    source.frame_bytes = data.nbytes
    monkeypatch.setattr("beamline.projections.read.HELD", 64)
    monkeypatch.setattr("beamline.projections.read.BATCH_BYTES", 5 * 4 * 4 * 2)
    got = read_binned(source, np.array([0, 2, 3, 4]), slice(1, 7), binning)
    np.testing.assert_array_equal(got, read_binned(plain, np.array([0, 2, 3, 4]), slice(1, 7), binning))
    assert len({tuple(frames) for frames, _ in source.was_read}) == 1 < len({tuple(f) for f, _ in plain.was_read})


@given(
    rows=st.integers(1, 9),
    cols=st.integers(1, 9),
    binning=st.integers(1, 4),
    holes=st.floats(0, 0.9),
    seed=st.integers(0, 99),
)
def test_bins_are_means_of_what_is_finite(rows: int, cols: int, binning: int, holes: float, seed: int) -> None:
    """Against a loop over the bins."""
    rng = np.random.default_rng(seed)
    data = rng.random((2, rows, cols)).astype(np.float32)
    data[rng.random(data.shape) < holes] = np.nan
    got = read_binned(ArraySource(data, [0, 0], np.zeros(2)), np.arange(2), slice(0, rows), binning)
    assert got.shape == (2, rows // binning, cols // binning)
    for v, r, c in np.ndindex(got.shape):
        block = data[v, r * binning : (r + 1) * binning, c * binning : (c + 1) * binning]
        if np.isfinite(block).any():
            assert got[v, r, c] == pytest.approx(float(np.nanmean(block)), rel=1e-5)
        else:
            assert np.isnan(got[v, r, c])


def test_flats_are_grouped_by_the_views_between_them() -> None:
    keys = [2, 1, 1, 0, 0, 0, 1, 3, 1, 0, 2, 1]
    data = np.arange(12, dtype=np.uint16)[:, None, None] * np.ones((1, 2, 2), np.uint16)
    source = ArraySource(data, keys, np.zeros(12))
    accepting = Selection(steps=(Preparation(references="accept"),))
    references, _ = read_references(select(source, accepting), slice(0, 2))
    assert [(position, float(flat[0, 0])) for position, flat in references.flats] == [
        (1.5, 1.5),
        (7.0, 7.0),
        (11.0, 11.0),
    ]
    assert references.dark[0, 0] == 5.0
