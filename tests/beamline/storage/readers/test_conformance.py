"""Our readers pass the conformance suite that is shipped."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import zarr
from numpy.typing import NDArray
from PIL import Image

from beamline.testing import ReaderConformance
from tests.beamline.storage.readers.test_dxchange import store
from tests.beamline.storage.readers.test_nxtomo import foreign

FRAMES = np.arange(6 * 4 * 5, dtype=np.uint16).reshape(6, 4, 5)


def _exchange(path: Path) -> Path:
    theta = np.linspace(0, 180, 4)
    return store(path, {"data": FRAMES[2:], "data_white": FRAMES[1:2], "data_dark": FRAMES[:1], "theta": theta})


def _pages(path: Path) -> Path:
    tifffile.imwrite(path, FRAMES, photometric="minisblack")
    return path


def _series(path: Path) -> Path:
    path.mkdir()
    for n, frame in enumerate(FRAMES):
        tifffile.imwrite(path / f"{n:03}.tif", frame)
    return path


def _npy(path: Path) -> Path:
    np.save(path, np.asfortranarray(FRAMES)[:, None])
    return path


def _zarr(path: Path) -> Path:
    frames: Any = FRAMES
    zarr.save_array(path, frames, zarr_format=3 if path.suffix == ".zarr" else 2)
    return path


def _zipped(path: Path) -> Path:
    folder = _zarr(path.with_name("scan.zarr2"))
    return Path(shutil.make_archive(str(path.with_suffix("")), "zip", folder.parent, folder.name))


def _images(path: Path) -> Path:
    path.mkdir()
    for n, frame in enumerate(FRAMES):
        if path.name == "png":
            Image.fromarray(frame).save(path / f"{n:03}.png")
        else:
            np.save(path / f"{n:03}.npy", frame[None])
    return path


SCANS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "nxtomo": ("scan.nxs", foreign),
    "dxchange": ("scan.h5", _exchange),
    "tiff_stack": ("scan.tif", _pages),
    "tiff_series": ("scan", _series),
    "npy": ("scan.npy", _npy),
    "zarr": ("scan.zarr", _zarr),
    "zarr_zip": ("scan.zip", _zipped),
    "png_series": ("png", _images),
    "npy_series": ("npy", _images),
}


class TestReaders(ReaderConformance):
    @pytest.fixture(params=list(SCANS.values()), ids=list(SCANS))
    def path(self, request: pytest.FixtureRequest, tmp_path: Path) -> Path:
        name, write = request.param
        found: Path = write(tmp_path / name)
        return found

    @pytest.fixture
    def frames(self) -> NDArray[Any]:
        return FRAMES
