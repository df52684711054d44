"""A scan of any format on the page: content of its stack, means and FBP slices."""

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.features.page.command import _scan
from beamline.page.shown_scan import ShownScan
from beamline.page.tiles import TileRegion
from beamline.storage.readers.open import open_scan
from recon.base.volume import Grid
from recon.prep.resample import Resampling
from tests.beamline.scans import BEAM, DARK, TwoCylinders, frames_of, write_exchange, write_flagged
from tests.messages import refused

SCAN = TwoCylinders()
ALL = TileRegion(0, 9999, 0, 9999)


def _angles(folder: Path) -> Path:
    np.savetxt(folder / "angles.txt", np.degrees(SCAN.angles))
    return folder / "angles.txt"


def _tiffs(folder: Path) -> Path:
    images: dict[str, NDArray[Any]] = {
        "dark": DARK * np.ones((1, *SCAN.shape)),
        "flat": (DARK + BEAM) * np.ones((1, *SCAN.shape)),
    }
    for kind, frames in {**images, "view": SCAN.counts()}.items():
        for n, image in enumerate(frames):
            tifffile.imwrite(folder / f"{kind}_{n:03}.tif", image.astype(np.uint16))
    _angles(folder)
    return folder


def _pages(folder: Path) -> tuple[Path, dict[str, Any]]:
    tifffile.imwrite(folder / "scan.tif", SCAN.counts(), photometric="minisblack")
    return folder / "scan.tif", {"angles": _angles(folder)}


def _plain(folder: Path) -> tuple[Path, dict[str, Any]]:
    with h5py.File(folder / "plain.h5", "w") as file:
        file["raw/images"], file["raw/deg"] = SCAN.counts(), np.degrees(SCAN.angles)
        file["raw/deg"].attrs["units"] = "deg"
    return folder / "plain.h5", {"data_path": "/raw/images", "angles_path": "/raw/deg"}


FORMATS: dict[str, Callable[[Path], tuple[Path, dict[str, Any]]]] = {
    "ours": lambda folder: (write_flagged(folder / "ours.h5", frames_of(SCAN), {}), {}),
    "data exchange": lambda folder: (write_exchange(folder / "scan.h5", SCAN), {}),
    "folder of TIFFs": lambda folder: (_tiffs(folder), {}),
    "TIFF": _pages,
    "HDF5 of any layout": _plain,
}
"""Writers of one scan, and the options that it needs."""


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ShownScan]:
    with closing(ShownScan(open_scan(write_exchange(tmp_path_factory.mktemp("scan") / "scan.h5", SCAN)))) as scan:
        yield scan


@pytest.mark.parametrize("name", FORMATS)
def test_views_of_any_format_are_slices(name: str, tmp_path: Path) -> None:
    source = _scan(*FORMATS[name](tmp_path))
    assert source is not None
    with closing(ShownScan(source)) as scan:
        view, sinogram = scan.stack.cut(0, 7, ALL).values, scan.stack.cut(1, 2, ALL).values
        light = np.exp(-SCAN.line_integrals())
        if not (source.table.kinds == 1).any():  # counts, as no flat says what the light is
            light = DARK + BEAM * light
        np.testing.assert_allclose(view, light[7], rtol=2e-3)
        np.testing.assert_allclose(sinogram, light[:, 2], rtol=2e-3)
        np.testing.assert_allclose(scan.mean("views"), light.mean(axis=0), rtol=2e-3)
        np.testing.assert_allclose(scan.stack.facts()["angles"], np.degrees(SCAN.angles), atol=1e-3)


def test_images_that_nothing_calls_a_scan_are_a_volume(tmp_path: Path) -> None:
    path, _ = _pages(tmp_path)
    assert _scan(path, {}) is None
    (tmp_path / "slices").mkdir()
    for n, image in enumerate(SCAN.counts()):
        tifffile.imwrite(tmp_path / "slices" / f"{n:03}.tif", image)
    assert _scan(tmp_path / "slices", {}) is None
    assert _scan(tmp_path / "absent.h5", {}) is None
    np.save(tmp_path / "volume.npy", np.ones((3, 4, 5), np.float32))
    assert _scan(tmp_path / "volume.npy", {}) is None


def test_the_axis_is_found_and_its_slice_is_the_sample(shown: ShownScan) -> None:
    found = shown.axis(2)
    assert found["axis"] == pytest.approx(SCAN.axis_col, abs=0.1)
    tile = shown.fbp(2, SCAN.axis_col, 0.0, ALL, fast=False)
    truth = SCAN.truth(Grid((1, *tile.values.shape)))[0]
    wrong = shown.fbp(2, SCAN.axis_col + 2, 0.0, ALL, fast=False).values
    errors = [float(np.sqrt(np.square(values - truth).mean())) for values in (tile.values, wrong)]
    assert errors[0] < 0.2 * truth.std() < errors[1]
    part = shown.fbp(2, SCAN.axis_col, 0.0, TileRegion(10, 30, 5, 25), fast=False)
    np.testing.assert_allclose(part.values, tile.values[10:30, 5:25], atol=1e-3 * truth.max())


def test_a_slice_with_a_tilt_is_that_of_views_turned_by_it(tmp_path: Path) -> None:
    high = TwoCylinders(shape=(40, 40))
    counts = high.counts().astype(np.float32)
    counts[:, 25:] = DARK + BEAM  # so that rows differ
    level = counts.copy()
    Resampling(high.shape, -math.radians(4)).apply(counts, 0)
    row, slices, bent = 5, list[NDArray[np.float32]](), np.empty((0, 0), np.float32)
    for name, views, tilt in (("level", level, 0.0), ("leaning", counts, 4.0)):
        path = write_exchange(tmp_path / f"{name}.h5", high, {"data": views.round().astype(np.uint16)})
        with closing(ShownScan(open_scan(path))) as scan:
            slices.append(scan.fbp(row, high.axis_col, tilt, ALL, fast=False).values)
            bent = scan.fbp(row, high.axis_col, 0.0, ALL, fast=False).values
    errors = [np.abs(values - slices[0])[8:-8, 8:-8].mean() for values in (slices[1], bent)]
    assert 4 * errors[0] < errors[1]


def test_what_cannot_be_shown_is_a_sentence(shown: ShownScan, tmp_path: Path) -> None:
    with refused(DataError):
        shown.fbp(4, 20.0, 0.0, ALL, fast=True)
    with refused(DataError):
        shown.mean("lights")
    tifffile.imwrite(tmp_path / "scan.tif", SCAN.counts(), photometric="minisblack")
    with closing(ShownScan(open_scan(tmp_path / "scan.tif"))) as scan, refused(DataError):
        scan.axis(0)
