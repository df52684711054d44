"""Several detectors in a file, broken links and locked files: read by name, or an error with the cause."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.readers.open import SourceOptions, open_scan
from tests.beamline.scans import write_nxtomo

N, SHAPE = 5, (4, 6)
KEYS = np.array([2, 1, 0, 0, 0])
ANGLES = np.array([0, 0, 0, 60, 120.0])


def frames(of: int) -> np.ndarray:
    return np.full((N, *SHAPE), 100 * of, np.uint16) + np.arange(N, dtype=np.uint16)[:, None, None]


def two_detectors(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        for k in (1, 2):
            detector = file.create_group(f"entry/instrument/camera{k}")
            detector["data"], detector["image_key"] = frames(k), KEYS
            file[f"entry/plot{k}/data"] = h5py.SoftLink(f"/entry/instrument/camera{k}/data")
        file["entry/sample/rotation_angle"] = ANGLES
        file["entry/sample/rotation_angle"].attrs["units"] = "deg"
    return path


@pytest.mark.parametrize("k", [1, 2])
def test_one_of_two_detectors_is_named_by_a_path_or_by_the_file(tmp_path: Path, k: int) -> None:
    path = two_detectors(tmp_path / "s.nx")
    with pytest.raises(DataError, match=r"several detectors.*camera1/data \(5 x 4 x 6\).*--data-path"):
        open_scan(path)
    for named in (f"/entry/instrument/camera{k}/data", f"entry/plot{k}/data"):
        with open_scan(SourceOptions(path, data_path=named)) as source:
            assert source.table.kinds.tolist() == KEYS.tolist() and source.quantity == "counts"
            np.testing.assert_array_equal(source.read(slice(None)), frames(k))
            np.testing.assert_allclose(np.degrees(source.table.angles), ANGLES)
    with h5py.File(path, "r+") as file:
        file.attrs["default"], file["entry"].attrs["default"] = "entry", f"plot{k}"
        file[f"entry/plot{k}"].attrs["signal"] = "data"
    with open_scan(path) as source:
        np.testing.assert_array_equal(source.read(slice(None)), frames(k))


def _exchange(file: h5py.File) -> None:
    file["exchange/data"], file["exchange/theta"] = frames(1)[2:], ANGLES[2:]


def _broken(path: Path, where: str, link: object) -> Path:
    if where.startswith("entry"):
        write_nxtomo(path, frames(1), KEYS, ANGLES)
    with h5py.File(path, "a") as file:
        if where.startswith("exchange"):
            _exchange(file)
        if where in file:
            del file[where]
        file[where] = link
    return path


@pytest.mark.parametrize("link", [h5py.ExternalLink("gone.h5", "/raw/data"), h5py.SoftLink("/nowhere")])
@pytest.mark.parametrize(
    "where",
    [
        "exchange/data", "exchange/data_dark", "exchange/data_white", "exchange/theta",
        "entry/instrument/detector/data", "entry/instrument/detector/image_key",
    ],
)  # fmt: skip
def test_a_link_that_leads_nowhere_is_named(tmp_path: Path, where: str, link: object) -> None:
    path = _broken(tmp_path / "s.h5", where, link)
    with pytest.raises(DataError, match=rf"/{where} is"):
        open_scan(path)


@pytest.mark.parametrize("number", [37, 38, 95])
def test_a_disk_without_locks_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    path, real = two_detectors(tmp_path / "s.nx"), h5py.File

    def without_locks(*args: object, locking: object = None, **rest: object) -> h5py.File:
        if locking is not False:
            raise OSError(f"Unable to open file (unable to lock file, errno = {number}, error message = 'x')")
        return real(*args, locking=locking, **rest)

    monkeypatch.setattr(h5py, "File", without_locks)
    with hdf5.open_hdf5(path) as file:
        assert "entry" in file
