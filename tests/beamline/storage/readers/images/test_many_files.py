"""TIFFs of many pages and archives of many files open at once, or are refused."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.storage.readers.images import tiff_series
from beamline.storage.readers.open import open_scan


def _pages(path: Path, n: int, odd: int = -1) -> Path:
    with tifffile.TiffWriter(path) as file:
        for i in range(n):
            file.write(np.full((4 + (i == odd), 6), i, np.uint16), contiguous=False)
    return path


def test_appended_pages_are_read_as_they_were_written_and_the_time_grows_with_their_number(tmp_path: Path) -> None:
    path = _pages(tmp_path / "a.tif", 2000)
    began = time.process_time()
    with open_scan(path) as source:
        spent = time.process_time() - began
        np.testing.assert_array_equal(source.read([0, 1999, 7])[:, 0, 0], [0, 1999, 7])
    began = time.process_time()
    with tifffile.TiffFile(path) as file:
        assert len(file.series) == 2000  # what it takes the square of the number for
    assert spent < 0.5 * (time.process_time() - began)


@pytest.mark.parametrize("odd", range(9))
def test_a_page_of_another_shape_among_many_is_named(tmp_path: Path, odd: int) -> None:
    with pytest.raises(DataError, match=r"\(5, 6\)"), open_scan(_pages(tmp_path / "a.tif", 9, odd)) as source:
        assert source.image_key.size == 9
        source.read(slice(None))


def test_a_folder_of_more_files_than_any_scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiff_series, "MOST_FILES", 5)
    for i in range(8):
        (tmp_path / f"{i}.tif").touch()
    with pytest.raises(DataError, match="holds more than 5 files"):
        open_scan(tmp_path)


def test_links_to_folders_are_followed_once(tmp_path: Path) -> None:
    for i in range(3):
        (tmp_path / "store").mkdir(exist_ok=True)
        tifffile.imwrite(tmp_path / f"store/s_{i}.tif", np.full((4, 6), i, np.uint16))
    (tmp_path / "scan").mkdir()
    tifffile.imwrite(tmp_path / "scan/dark_0.tif", np.full((4, 6), 9, np.uint16))
    (tmp_path / "scan/proj").symlink_to("../store")
    (tmp_path / "scan/again").symlink_to("../store")
    (tmp_path / "store/up").symlink_to("../scan")
    (tmp_path / "scan/lost").symlink_to("../gone")
    with open_scan(tmp_path / "scan") as source:
        np.testing.assert_array_equal(source.read(slice(None))[:, 0, 0], [9, 0, 1, 2])
