"""Selections: columns through binning and back; words, rows, bins and axes that do not fit a scan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.errors import ConfigError
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection, unbinned
from beamline.projections.views import select
from beamline.storage.readers.open import open_scan
from recon.base.geometry import Geometry
from tests.beamline.array_source import scan_of
from tests.beamline.scans import TwoCylinders, write_exchange


@given(column=st.floats(-10, 5000), binning=st.integers(1, 16))
def test_unbinned_inverts_the_geometrys_binning(column: float, binning: int) -> None:
    binned = Geometry.parallel([0.0], (16, 6000), pixel_pitch=1.0, axis_col=column).binned(binning).axis_col
    assert unbinned(binned, binning) == pytest.approx(column, abs=1e-6)


@pytest.mark.parametrize(
    ("selection", "said"),
    [
        (Selection(views="nonsense"), "--views: .*'nonsense'.*fixed:N"),
        (Selection(views="first:1"), "at least 2"),
        (Selection(rows=(2, 9), axis_col=20.0), "--rows 2:9"),
        (Selection(binning=5, axis_col=20.0), "--bin 5"),
        (Selection(axis_col=40.0), "outside the detector"),
    ],
)
def test_selections_that_do_not_fit(tmp_path: Path, selection: Selection, said: str) -> None:
    path = write_exchange(tmp_path / "scan.h5", TwoCylinders())
    with open_scan(path) as source, pytest.raises(ConfigError, match=said):
        prepare_projections(select(source, selection), pytest.fail)


def test_the_central_ray_meets_the_row_that_is_given_whatever_rows_are_read() -> None:
    source: Any = scan_of(np.ones((1, 8, 6)), np.ones((1, 8, 6)), np.ones((3, 8, 6)), np.arange(3.0))
    cone = Selection(cone=(20, 40), pixel_size_mm=0.2, central_row=9.0)  # off the detector
    assert cone.of(source).geometry(2.5, np.arange(3.0)).axis_row == 9
    half = replace(cone, rows=(2, 8), binning=2)
    assert half.of(source).geometry(2.5, np.arange(3.0)).axis_row == (9 - 2 - 0.5) / 2
    with pytest.raises(ConfigError, match="--central-row is for a cone beam, and array is a parallel-beam scan"):
        replace(cone, cone=None).of(source).geometry(2.5, np.arange(3.0))
