"""Frames whose pixels differ from what was written are named, and used only if the user asks for it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.projections.corrections.air import Air
from beamline.projections.preparation import Preparation
from beamline.projections.prepare import DiskBuffer
from beamline.projections.selection import Selection
from beamline.storage.writers import layout
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged
from tests.slow_cases import others_slow

SCAN = TwoCylinders()
SELECTION = Selection(axis_col=SCAN.axis_col, steps=(Air("none"),))
IGNORE = SELECTION.with_steps(Preparation("ignore"))
DARKS, FLATS, VIEWS = (0, 1), (2, 3), 4  # rows of the file


def scan(folder: Path, *damaged: int, bit: int = 14) -> Path:
    """The scan with one bit of the last pixel flipped in these rows, after it was written."""
    path = write_flagged(folder / "scan.h5", frames_of(SCAN), {})
    with h5py.File(path, "r+") as file:
        for row in damaged:
            file[layout.DATA][row, -1, -1] ^= 1 << bit
    return path


@pytest.mark.parametrize(
    ("rows", "on_disk"),
    others_slow([((1, 4), True), (None, False)]),
    ids=["most of their rows, on disk", "whole frames"],
)
def test_damaged_views_are_left_out_and_named(tmp_path: Path, rows: tuple[int, int] | None, on_disk: bool) -> None:
    path, height = scan(tmp_path, 9, 20, 21, bit=0), 4 if rows is None else 3
    buffer = DiskBuffer(np.empty((45, height, 40), np.float32), 7) if on_disk else None
    prepared, told = prepare(path, replace(SELECTION, rows=rows), buffer)
    np.testing.assert_array_equal(prepared.ids, np.setdiff1d(np.arange(4, 49), [9, 20, 21]))
    said = " ".join(told)
    assert (
        ("frame 9 differs" in said and "frames 20-21 differ" in said) if on_disk else "frames 9, 20-21 differ" in said
    )
    assert "left out" in said


def test_flags_ignore_uses_them_and_says_so(tmp_path: Path) -> None:
    prepared, (said,) = prepare(scan(tmp_path, 9, bit=0), IGNORE)
    assert prepared.ids.size == 45
    assert "frame 9 differs from the stored checksum" in said and "used anyway" in said


def test_a_damaged_reference_is_left_out_of_the_mean(tmp_path: Path) -> None:
    good, told = prepare(scan(tmp_path), SELECTION)
    assert told == []
    (tmp_path / "scan.h5").unlink()
    spoilt, told = prepare(scan(tmp_path, 1, 3), SELECTION)
    assert "frames 1, 3 differ" in told[0] and "left out" in told[0]
    # One count is in the last pixel of the good second flat: 1/20000 of the light, half of it in the mean.
    np.testing.assert_allclose(spoilt.seen.data, good.seen.data, atol=1e-4)


@pytest.mark.parametrize(("rows", "kind"), others_slow([(FLATS, "flats"), (DARKS, "darks")]))
def test_references_that_are_all_damaged_are_refused(tmp_path: Path, rows: tuple[int, int], kind: str) -> None:
    path = scan(tmp_path, *rows, bit=0)
    with pytest.raises(DataError, match=f"all {kind} are damaged"):
        prepare(path, SELECTION)
    assert prepare(path, IGNORE)[0].ids.size == 45
