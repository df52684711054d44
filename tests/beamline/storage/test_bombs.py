"""Sizes are looked at before bytes: what claims more than a scan has is refused, and `info` ends in time."""

from __future__ import annotations

import io
import os
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.storage import describe as described
from beamline.storage import hdf5
from beamline.storage.readers import tiff_series, wrapped
from beamline.storage.readers.open import open_scan
from tests.beamline.scans import TwoCylinders, write_exchange


def test_a_member_of_a_zip_and_angles_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiff_series, "LARGEST_IMAGE", 10_000)
    folder = tmp_path / "series"
    folder.mkdir()
    for n in range(3):
        tifffile.imwrite(folder / f"p_{n:03d}.tif", np.full((8, 8), n, np.uint16))
    (folder / "angles.txt").touch()
    os.truncate(folder / "angles.txt", 2**31)
    with pytest.raises(DataError, match=r"angles\.txt .*2\.15 GB, and at most 67\.1 MB"):
        open_scan(folder)
    with zipfile.ZipFile(tmp_path / "s.zip", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("p_000.tif", bytes(10_001))
    with pytest.raises(DataError, match="at most 10 kB are read"):
        open_scan(tmp_path / "s.zip")


def test_info_unpacks_no_large_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wrapped, "UNPACKED", 2**22)
    image = io.BytesIO()
    tifffile.imwrite(image, np.zeros((4096, 4096), np.uint16))
    with zipfile.ZipFile(tmp_path / "s.zip", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        for n in range(2):
            packed.writestr(f"p_{n:03d}.tif", image.getvalue())
    tracemalloc.start()
    facts = described.describe(tmp_path / "s.zip")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert facts["shape"] == (4096, 4096) and facts["dtype"] == "uint16"
    assert peak < 1.2 * image.tell()  # zipfile unpacks 16 MB and copies them, to find the end of a member


def test_info_does_not_wait_for_frames_that_each_cost_the_whole_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_exchange(tmp_path / "a.h5", TwoCylinders())
    monkeypatch.setattr(wrapped, "UNPACKED", 100)
    (said,) = [message for message in described.describe(path)["findings"] if "too long" in message]
    assert "beamline validate" in said
    monkeypatch.undo()
    monkeypatch.setattr(described, "LOOK", -1.0)
    assert any("too long" in message for message in described.describe(path)["findings"])


def test_a_list_larger_than_any_scan_has(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        chunk = (1, 1024, 1024)
        item = file.create_dataset("list", (200, 1024, 1024), "i4", chunks=chunk, compression="gzip")
        packed = zlib.compress(bytes(2**22), 9)
        for n in range(200):
            item.id.write_direct_chunk((n, 0, 0), packed)
        with pytest.raises(DataError, match=r"holds 0\.839 GB; expected a number, a text or a list"):
            hdf5.values_of(item)
        assert hdf5.first_of(item) == 0
