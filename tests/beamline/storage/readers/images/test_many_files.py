"""TIFFs with many pages and archives with many files open at once, or end with an error."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import tifffile

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
