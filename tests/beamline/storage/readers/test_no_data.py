"""Module gaps and photon counters: marker values are not counts; a dark of 0 is used if the noise shows it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.storage.readers.open import open_scan
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.scan import findings_of
from tests.beamline.scans import write_nxtomo

SHAPE, FLATS, VIEWS = (24, 40), 5, 20
MASK = np.zeros(SHAPE, np.uint32)
MASK[:, 11:13], MASK[17] = 1, 256


def _scan(
    path: Path,
    rng: np.random.Generator,
    dtype: str,
    mark: int | None = None,
    mask: NDArray[np.uint32] | None = None,
    gain: float = 1.0,
    offset: int = 0,
) -> Path:
    """Counts of a photon counter, or of a camera with a gain and an offset; no darks."""
    light = np.concatenate([np.full((FLATS, *SHAPE), 900.0), np.full((VIEWS, *SHAPE), 300.0)])
    frames = np.round(rng.poisson(light) * gain + offset).astype(np.int64)
    if mark is not None:
        frames[:, MASK > 0] = mark
    keys = np.repeat([1, 0], [FLATS, VIEWS])
    write_nxtomo(path, frames.astype(dtype), keys, np.arange(FLATS + VIEWS) * 9.0)
    if mask is not None:
        with h5py.File(path, "r+") as file:
            file["entry/instrument/detector/pixel_mask"] = mask
    return path


@pytest.mark.parametrize(
    ("dtype", "mark", "stated"),
    [
        ("u4", 2**32 - 1, False), ("u4", 2**32 - 1, True), ("u2", 65535, True), ("u2", 65535, False), ("i4", -1, False),
        ("u2", 123, True),
    ],
)  # fmt: skip
def test_marked_pixels_hold_no_counts_and_a_counter_needs_no_darks(
    tmp_path: Path, rng: np.random.Generator, dtype: str, mark: int, stated: bool
) -> None:
    path = _scan(tmp_path / "s.nx", rng, dtype, mark, MASK if stated else None)
    with open_scan(path) as source:
        assert source.table.kinds[0] == 2
        assert not source.read([0]).any()
        assert not source.read([1, -1])[:, MASK > 0].any()
        np.testing.assert_array_equal(source.read([-1], slice(10, 20))[0], source.read([-1])[0, 10:20])
        assert source.read([-1])[0, 0, 0] > 200
        assert not [finding for finding in findings_of(ScanEvidence(source)) if finding.rule == "references"]
        assert "counted photons" in str(source.attributes["darks"])


@pytest.mark.parametrize(
    ("gain", "offset", "dtype", "mark"),
    [
        (0.5, 0, "u4", 2**32 - 1),
        (2.0, 0, "u4", 2**32 - 1),
        (1.0, 100, "u4", 2**32 - 1),
        (1.0, 0, "u2", None),  # nothing is marked: any camera
    ],
)
def test_cameras_need_darks(
    tmp_path: Path, rng: np.random.Generator, gain: float, offset: int, dtype: str, mark: int | None
) -> None:
    with open_scan(_scan(tmp_path / "s.nx", rng, dtype, mark, None, gain, offset)) as source:
        assert [f.message for f in findings_of(ScanEvidence(source)) if "darks are missing" in f.message]


@pytest.mark.parametrize("where", [np.s_[:, :, 5:20], np.s_[:, 4:9, 5:20], np.s_[:5]])
def test_too_much_light_is_no_mark(tmp_path: Path, rng: np.random.Generator, where: tuple[slice, ...]) -> None:
    """Air that is saturated in flats and views, as whole columns, too: more of such flats is than of views."""
    path = _scan(tmp_path / "s.nx", rng, "u2")
    with h5py.File(path, "r+") as file:
        frames = file["entry/instrument/detector/data"][()]
        frames[:FLATS, :, 4:30] = 65535
        frames[where] = 65535
        file["entry/instrument/detector/data"][...] = frames
    with open_scan(path) as source:
        np.testing.assert_array_equal(source.read(slice(None)), frames)


def test_a_mask_is_mirrored_with_its_frames(tmp_path: Path, rng: np.random.Generator) -> None:
    path = _scan(tmp_path / "s.nx", rng, "u4", 2**32 - 1, MASK)
    with h5py.File(path, "r+") as file:
        file["entry/instrument/detector/x_flipped"] = True
    with open_scan(path) as source:
        assert not source.read([-1])[0, :, ::-1][MASK > 0].any()
        assert source.read([-1]).max() < 1000
