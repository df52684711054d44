"""A file that reads from a pipe, is nested without end or claims impossible sizes ends with an error before reading."""

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
from beamline.storage.readers.reference_files import load_images
from beamline.storage.volume_file import read_volume
from drivers.base.frame import Frame, FrameKind
from tests.messages import refused

PIPES = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")


def _external(file: h5py.File, name: str) -> None:
    file["entry/notes"] = h5py.ExternalLink(name, "/x")


def _virtual(file: h5py.File, name: str) -> None:
    layout = h5py.VirtualLayout((3,), "i4")
    layout[:] = h5py.VirtualSource(name, "/x", (3,))
    file.create_virtual_dataset("entry/notes", layout)


@PIPES
@pytest.mark.parametrize("draw", [_external, _virtual])
def test_a_scan_that_draws_on_a_pipe(tmp_path: Path, path: Path, draw: Callable[[h5py.File, str], None]) -> None:
    """Also one that was harmless when it was opened before, or whose source was not there yet."""
    open_scan(path).close()
    with h5py.File(path, "r+") as file:
        draw(file, "pipe")
    open_scan(path).close()
    os.mkfifo(tmp_path / "pipe")
    with refused(DataError):
        open_scan(path)


def test_values_that_are_the_bytes_of_another_file_and_claims_without_bytes(tmp_path: Path, path: Path) -> None:
    (tmp_path / "secret").write_bytes(b"token")
    with h5py.File(path, "r+") as file:
        file.create_dataset("entry/notes", (5,), "u1", external=[(str(tmp_path / "secret"), 0, 5)])
    with pytest.raises(DataError, match=r"notes has its values in .*secret"):
        open_scan(path)
    with h5py.File(path, "r+") as file:
        del file["entry/notes"]
        file.create_dataset("entry/notes", (2**31,), "u1", chunks=(2**31,), compression="gzip")
    with pytest.raises(DataError, match=r"states 2\.15 GB"):
        open_scan(path)
    with h5py.File(path, "r+") as file:  # a chunk of 512 MiB, of which the dataset shows ten values
        del file["entry/notes"]
        notes = file.create_dataset("entry/notes", (10,), "u1", chunks=(2**29,), maxshape=(None,), compression="gzip")
        notes.id.write_direct_chunk((0,), zlib.compress(bytes(10**6)))
    with pytest.raises(DataError, match=r"states 0\.537 GB"):
        open_scan(path)


def test_links_to_nothing_to_folders_to_itself_and_in_circles_do_no_harm(path: Path, frames: list[Frame]) -> None:
    with h5py.File(path, "r+") as file:
        for n, name in enumerate(("missing.h5", ".", path.name, "a\0b")):
            file[f"entry/l{n}"] = h5py.ExternalLink(name.partition("\0")[0], "/")
        file["entry/soft"] = h5py.SoftLink("/entry/soft")
        file["entry/circle"] = file["entry"]
    with open_scan(path) as source:
        assert len(source.table) == len(frames)


def test_a_file_whose_root_group_is_damaged_is_an_error_of_the_data(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[content.index(b"OHDR") + 20] ^= 1
    path.write_bytes(content)
    with refused(DataError):
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


def _drawn(name: str, where: str) -> Callable[[h5py.File, str], None]:
    def draw(file: h5py.File, place: str) -> None:
        layout = h5py.VirtualLayout((2, 8, 8), "u2")
        layout[:] = h5py.VirtualSource(name, where, (2, 8, 8))
        file.create_virtual_dataset(place, layout)

    return draw


def test_a_percent_sign_in_the_name_of_a_source(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "part_50%.h5", "w") as file:
        file["a%b"] = np.ones((2, 8, 8), "u2")
    with h5py.File(tmp_path / "whole.h5", "w") as file:
        _drawn("part_50%%.h5", "a%%b")(file, "data")
        _drawn("gone_%%.h5", "a%%b")(file, "lost")
    with open_hdf5(tmp_path / "whole.h5") as file:
        assert datasets.missing_links(file["data"]) == [] and file["data"][()].all()
        assert datasets.missing_links(file["lost"]) == [str(tmp_path / "gone_%.h5")]
    with refused(DataError):
        structure.plain_name("part_%b.h5")


@PIPES
def test_a_pipe_in_a_folder_or_by_its_name(tmp_path: Path) -> None:
    for n in range(3):
        tifffile.imwrite(tmp_path / f"p_{n:03d}.tif", np.full((8, 8), n, np.uint16))
    os.mkfifo(tmp_path / "p_003.tif")
    with pytest.raises(DataError, match="a device or a pipe"):
        read_volume(tmp_path)
    for read in (read_volume, open_hdf5):
        with refused(DataError):
            read(tmp_path / "p_003.tif")
    for place in (tmp_path, tmp_path / "p_003.tif"):
        with refused(DataError):
            load_images(place, FrameKind.DARK, (8, 8))
