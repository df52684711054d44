"""The corrector reads what is asked for and the references, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.projections.correction import ScanCorrection
from beamline.projections.selection import Selection
from recon.prep.correct import CorrectionSettings
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
    assert {rows for _, rows in source.was_read} == {2}
    assert sorted(f for frames, _ in source.was_read for f in frames) == [0, 1, 2, 3, 4, 5, 6]
