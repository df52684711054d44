"""Sizes are looked at before bytes: what claims more than a scan has is refused."""

from __future__ import annotations

import os
import zipfile
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.readers.images import tiff_series
from beamline.storage.readers.open import open_scan


def test_a_member_of_a_zip_and_angles_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiff_series, "LARGEST_IMAGE", 10_000)
    folder = tmp_path / "series"
    folder.mkdir()
    for n in range(3):
        tifffile.imwrite(folder / f"p_{n:03d}.tif", np.full((8, 8), n, np.uint16))
    (folder / "angles.txt").touch()
    os.truncate(folder / "angles.txt", 2**31)
    with pytest.raises(DataError, match=r"angles\.txt .*2\.15 GB"):
        open_scan(folder)
    with zipfile.ZipFile(tmp_path / "s.zip", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("p_000.tif", bytes(10_001))
    with pytest.raises(DataError, match="most 10 kB"):
        open_scan(tmp_path / "s.zip")


def test_a_list_larger_than_any_scan_has(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        chunk = (1, 1024, 1024)
        item = file.create_dataset("list", (200, 1024, 1024), "i4", chunks=chunk, compression="gzip")
        packed = zlib.compress(bytes(2**22), 9)
        for n in range(200):
            item.id.write_direct_chunk((n, 0, 0), packed)
        with pytest.raises(DataError, match=r"holds 0\.839 GB"):
            hdf5.values_of(item)
        assert hdf5.first_of(item) == 0
