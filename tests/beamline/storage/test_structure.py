"""A file that draws on a pipe, is nested without end or claims more than a scan has is refused before it is read."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.storage import datasets, structure
from beamline.storage.hdf5 import open_hdf5
from beamline.storage.readers.images import tiff_series
from beamline.storage.readers.open import open_scan
from drivers.base.frame import Frame

PIPES = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")


def _external(file: h5py.File, name: str) -> None:
    file["entry/notes"] = h5py.ExternalLink(name, "/x")


def _virtual(file: h5py.File, name: str) -> None:
    layout = h5py.VirtualLayout((3,), "i4")
    layout[:] = h5py.VirtualSource(name, "/x", (3,))
    file.create_virtual_dataset("entry/notes", layout)


def _raw(file: h5py.File, name: str) -> None:
    file.create_dataset("entry/notes", (3,), "i4", external=[(name, 0, 12)])


@PIPES
@pytest.mark.parametrize("draw", [_external, _virtual, _raw])
@pytest.mark.parametrize("by_another_file", [False, True])
def test_a_scan_that_draws_on_a_pipe(
    tmp_path: Path, path: Path, draw: Callable[[h5py.File, str], None], by_another_file: bool
) -> None:
    os.mkfifo(tmp_path / "pipe")
    with h5py.File(path, "r+") as file, h5py.File(tmp_path / "other.h5", "w") as other:
        if by_another_file:
            draw(other, "pipe")
            file["entry/other"] = h5py.ExternalLink("other.h5", "/")
        else:
            draw(file, "pipe")
    with pytest.raises(DataError, match=r"links to .*or a pipe"):
        open_scan(path)


def test_links_to_nothing_to_folders_to_itself_and_in_circles_do_no_harm(path: Path, frames: list[Frame]) -> None:
    with h5py.File(path, "r+") as file:
        for n, name in enumerate(("missing.h5", ".", path.name, "a\0b")):
            file[f"entry/l{n}"] = h5py.ExternalLink(name.partition("\0")[0], "/")
        file["entry/soft"] = h5py.SoftLink("/entry/soft")
        file["entry/circle"] = file["entry"]
    with open_scan(path) as source:
        assert source.image_key.size == len(frames)


@pytest.mark.parametrize(("groups", "deep"), [(1500, True), (300, False)])
def test_more_groups_than_any_scan_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, groups: int, deep: bool
) -> None:
    monkeypatch.setattr(structure, "MOST_OBJECTS", 200 if not deep else 50_000)
    path = tmp_path / "a.h5"
    with h5py.File(path, "w", libver="latest") as file:
        place = file
        for n in range(groups):
            made = place.create_group(f"g{n}")
            place = made if deep else place
    with pytest.raises(DataError, match="than 64 deep"):
        open_hdf5(path)


def test_a_dataset_that_claims_an_impossible_size(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("real", data=np.zeros(1000))
        file.create_dataset("claimed", (2**40, 2, 2), "f8", chunks=(64, 2, 2))
    with pytest.raises(DataError, match=r"3\.52e\+04 GB"):
        open_hdf5(tmp_path / "a.h5")


def test_a_file_whose_root_group_is_damaged_is_an_error_of_the_data(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[content.index(b"OHDR") + 20] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"damaged|cannot be read as HDF5"):
        open_hdf5(path)


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
            datasets.values_of(item)
        assert datasets.first_of(item) == 0
