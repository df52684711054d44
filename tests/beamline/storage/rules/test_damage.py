"""Files damaged by a disk, memory or another program: frames are named and not used."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import describe, validate
from beamline.storage.recover import recover
from drivers.base.frame import Frame
from tests.beamline.scans import TwoCylinders, write_exchange
from tests.beamline.storage.conftest import SHAPE

DETECTOR = "entry/instrument/detector"


def flip(path: Path, at: int, bit: int) -> None:
    """Flip one bit of a file, as a disk or a memory does."""
    content = bytearray(path.read_bytes())
    content[at] ^= 1 << bit
    path.write_bytes(content)


def test_a_flipped_bit_of_any_pixel_is_found_in_its_frame(
    path: Path, frames: list[Frame], rng: np.random.Generator
) -> None:
    rows = 0, 4, 13  # a dark, a flat, a view
    with h5py.File(path) as file:
        offsets = {row: file[f"{DETECTOR}/data"].id.get_chunk_info_by_coord((row, 0, 0)).byte_offset for row in rows}
    for row in rows:
        at, bit = offsets[row] + int(rng.integers(2 * SHAPE[0] * SHAPE[1])), int(rng.integers(8))
        flip(path, at, bit)
        told: list[tuple[int, int]] = []
        (hit,) = [hit for hit in validate(path, deep=lambda n, of: told.append((n, of))) if hit.rule == "checksums"]  # noqa: B023
        assert hit.severity == "error"
        assert f"1 of 14 frames are damaged, because they differ from their stored checksums: {row}." in hit.message
        assert told == [(n, 14) for n in range(1, 15)]
        flip(path, at, bit)
    assert validate(path, deep=lambda n, of: None) == []


def test_frames_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    path = write_exchange(tmp_path / "scan.h5", TwoCylinders())
    told = [hit.rule for hit in validate(path, deep=lambda n, of: None)]
    assert told == ["constant-darks", "checksums"]  # those are made up, and it has none of these
    with h5py.File(path, "r+") as file:
        data = file["exchange/data"][()]
        del file["exchange/data"]
        packed = file.create_dataset("exchange/data", data=data, chunks=(1, *data.shape[1:]), compression="gzip")
        offset = packed.id.get_chunk_info(30).byte_offset
    flip(path, offset + 8, 3)
    (hit,) = [hit for hit in validate(path, deep=lambda n, of: None) if hit.rule == "unreadable"]
    assert hit.message.startswith("1 frame cannot be read: 34. Frame 30 of /exchange/data in ")


def test_a_damaged_scan_is_not_ingested(path: Path, tmp_path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file[f"{DETECTOR}/data"][6, 0, 0] ^= 8
    with pytest.raises(DataError, match=r"Frame 6 of .* differ from the stored checksum"):
        ingest(path, tmp_path / "copy.h5")
    assert [left.name for left in tmp_path.iterdir()] == ["scan.h5"]


ALTERATIONS = {
    "a null dataspace": h5py.Empty("f4"),
    "a text": "words",
    "other dimensions": np.zeros((3, 3, 3, 3)),
    "a link in a circle": None,
    "nothing": np.zeros(0),
    "a negative number": np.int64(-5),
    "a huge number": np.int64(2**62),
    "nested lists": "[" * 3000,
}


PLACES = (
    "instrument/detector/image_key",
    "frame_log/flags",
    "progress/frames_committed",
    "progress/status",
    "record/plan",
)
OF_FRAMES = PLACES[:3]


def refusal(ask: Callable[[Path], object], path: Path) -> str:
    """Its words; empty where the file is taken."""
    try:
        ask(path)
    except DataError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("quick", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["each once", "all"])
def test_altered_files_are_described_or_refused_in_words(path: Path, quick: bool, tmp_path: Path) -> None:
    whole, each_once = path, list(zip(ALTERATIONS, PLACES * 2, strict=False))
    for what, where in each_once if quick else product(ALTERATIONS, PLACES):
        value = ALTERATIONS[what]
        path = tmp_path / f"{what}.h5"
        shutil.copy(whole, path)
        with h5py.File(path, "r+") as file:
            del file["entry"][where]
            file["entry"][where] = h5py.SoftLink(f"/entry/{where}") if value is None else value
        found = validate(path, deep=lambda n, of: None)
        asked = describe, recover, partial(ingest, out=tmp_path / f"copy of {what}.h5")
        refused = [refusal(ask, path) for ask in asked]
        assert all(path.name in said for said in refused if said), (what, where, refused)
        assert found or not refused[0], (what, where)
        assert found or where not in OF_FRAMES, (what, where)
        (tmp_path / f"copy of {what}.h5").unlink(missing_ok=True)
