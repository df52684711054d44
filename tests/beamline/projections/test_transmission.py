"""Frames that were already divided by flats: recognised as transmission, never used as line integrals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.features.files.validate import validate
from beamline.projections.corrections.air import Air
from beamline.projections.selection import Selection
from beamline.storage.readers.open import SourceOptions
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import TwoCylinders, write_exchange, write_nxtomo

SCAN = TwoCylinders()
LINES = SCAN.line_integrals()
SELECTION = Selection(axis_col=SCAN.axis_col, steps=(Air("none"),))
FACTS: dict[str, Any] = {"angles": SCAN.angles}


def stack(path: Path, values: np.ndarray, dtype: Any = np.float32) -> Path:
    tifffile.imwrite(path, values.astype(dtype), photometric="minisblack")
    return path


def lines(path: Path, **facts: Any) -> np.ndarray:
    return prepare(path, SELECTION, **FACTS, **facts)[0].seen.data


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_it_becomes_line_integrals_by_name_and_by_flats_of_one(
    tmp_path: Path, noise: float, rng: np.random.Generator
) -> None:
    path = stack(tmp_path / "t.tif", np.exp(-LINES) + noise * rng.standard_normal(LINES.shape))
    named = lines(path, quantity="transmission")
    np.testing.assert_allclose(named, LINES, atol=12 * noise + 1e-5)
    shape = (1, *SCAN.shape)
    np.testing.assert_array_equal(lines(path, darks=np.zeros(shape), flats=np.ones(shape)), named)


def test_whole_numbers_have_a_flat_of_their_own(tmp_path: Path) -> None:
    path, shape = stack(tmp_path / "t.tif", 6e4 * np.exp(-LINES), np.uint16), (1, *SCAN.shape)
    flats = np.full(shape, 60000, np.uint16)
    np.testing.assert_allclose(lines(path, darks=np.zeros(shape, np.uint16), flats=flats), LINES, atol=1e-4)
    with pytest.raises(DataError, match="from 0 to 1"):
        lines(path, quantity="transmission")


@pytest.mark.parametrize("beam", [0.95, 1.08])
def test_it_is_never_taken_as_line_integrals(tmp_path: Path, beam: float) -> None:
    path = stack(tmp_path / "t.tif", beam * np.exp(-LINES))
    for quantity in ("line_integrals", None):
        with pytest.raises(DataError, match=r"Give --quantity transmission.*the sample"):
            lines(path, quantity=quantity)
    assert (
        "Give --quantity transmission" in validate(SourceOptions(path, **FACTS, quantity="line_integrals"))[0].message
    )


@pytest.mark.parametrize("kind", ["exchange", "nxtomo"])
def test_files_of_other_systems_state_it_likewise(tmp_path: Path, kind: str) -> None:
    path, light = tmp_path / "t.h5", np.exp(-LINES).astype(np.float32)
    if kind == "exchange":
        write_exchange(path, SCAN, {"data": light, "data_white": None, "data_dark": None})
    else:
        write_nxtomo(path, light, np.zeros(len(LINES), int), np.degrees(SCAN.angles))
    prepared, _ = prepare(path, SELECTION, quantity="transmission")
    np.testing.assert_allclose(prepared.seen.data, LINES, atol=1e-5)
