"""The correction of a scan reads what is asked for and the references, and gives the same in batches as at once."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from beamline.projections.correction import ScanCorrection
from beamline.projections.selection import Selection
from recon.prep.correct import CorrectionSettings, merge_and_empty
from tests.beamline.array_source import ArraySource
from tests.beamline.scans import BEAM, DARK, TwoCylinders

SCAN = TwoCylinders()


def test_only_what_was_asked_for_is_read() -> None:
    counts = SCAN.counts()
    data = np.concatenate([np.full((1, 4, 40), DARK), np.full((1, 4, 40), DARK + BEAM), counts]).astype(np.uint16)
    source = ArraySource(data, [2, 1] + [0] * 45, np.concatenate([[np.nan] * 2, SCAN.angles]))
    selection = Selection(views="first:5", rows=(1, 3), axis_col=20.7, correction=CorrectionSettings(air="none"))
    correction = ScanCorrection(source, selection, pytest.fail)  # type: ignore[arg-type]
    correction.at_once(np.arange(2, 7))
    assert {rows for frames, rows in source.was_read if min(frames) >= 2} == {2}
    assert max(len(frames) for frames, rows in source.was_read if rows == 4) == 1  # a whole reference, to judge it
    assert {f for frames, _ in source.was_read for f in frames} == {0, 1, 2, 3, 4, 5, 6}


@pytest.mark.parametrize("air", ["auto", "none", (3, 3)])
@pytest.mark.parametrize("sizes", [[45], [1] * 45, [32, 13], [7, 20, 18]])
@pytest.mark.parametrize("ended", ["with the last batch", "later"])
def test_batches_are_the_views_at_once_also_where_the_end_comes_later(
    sizes: list[int], air: object, ended: str
) -> None:
    counts = SCAN.counts()
    data = np.concatenate([np.full((1, 4, 40), DARK), np.full((1, 4, 40), DARK + BEAM), counts]).astype(np.uint16)
    source = ArraySource(data, [2, 1] + [0] * 45, np.concatenate([[np.nan] * 2, SCAN.angles]))
    selection = Selection(correction=CorrectionSettings(air=air))  # type: ignore[arg-type]
    correction = ScanCorrection(source, selection, pytest.fail)  # type: ignore[arg-type]
    ends = np.cumsum([2, *sizes])
    batches = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
    fed = [correction.feed(batch, last=ended != "later" and batch[-1] == 46) for batch in batches]
    if ended == "later":
        fed.append(correction.feed(np.arange(0), last=True))
    parts = merge_and_empty([part for part in fed if part is not None])
    whole = correction.renewed().at_once(np.arange(2, 47))
    if not correction.outdated:
        np.testing.assert_array_equal(parts.data, whole.data)
    assert correction.outdated <= (air == "auto" and len(sizes) > 1)
    np.testing.assert_array_equal(parts.view_ids, whole.view_ids)


def test_line_integrals_need_no_neighbour() -> None:
    source = ArraySource(SCAN.counts().astype(np.float32), [0] * 45, SCAN.angles)
    source.quantity = "line_integrals"
    correction = ScanCorrection(source, Selection(), pytest.fail)  # type: ignore[arg-type]
    parts = [correction.feed(np.arange(0, 20), last=False), correction.feed(np.arange(20, 45), last=False)]
    assert correction.feed(np.arange(0), last=True) is None and not correction.outdated
    whole = merge_and_empty([part for part in parts if part is not None])
    np.testing.assert_array_equal(whole.data, correction.at_once(np.arange(45)).data)
