"""What lies outside of a scan's file: text is never copied from a file that holds no images, and is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import describe
from beamline.storage.readers.open import open_scan
from tests.beamline.scans import TwoCylinders, frames_of, write_exchange, write_flagged

SECRET = b"root:x:0:0:the operator's secret:/root:/bin/sh\n"
SCAN = TwoCylinders()


def _raw(file: h5py.File, place: str, other: Path) -> None:
    file.create_dataset(place, (1,), f"S{len(SECRET)}", external=[(str(other), 0, len(SECRET))])


def _as_numbers(file: h5py.File, place: str, other: Path) -> None:
    file.create_dataset(place, (len(SECRET),), "u1", external=[(str(other), 0, len(SECRET))])


def _link(file: h5py.File, place: str, other: Path) -> None:
    file[place] = h5py.ExternalLink(_in_hdf5(other), "notes/name")


def _linked_group(file: h5py.File, place: str, other: Path) -> None:
    file.pop(str(Path(place).parent), None)
    file[str(Path(place).parent)] = h5py.ExternalLink(_in_hdf5(other), "notes")


def _virtual(file: h5py.File, place: str, other: Path) -> None:
    layout = h5py.VirtualLayout((1,), f"S{len(SECRET)}")
    layout[:] = h5py.VirtualSource(_in_hdf5(other), "fixed", (1,))
    file.create_virtual_dataset(place, layout)


def _in_hdf5(other: Path) -> str:
    path = other.with_suffix(".h5")
    with h5py.File(path, "w") as file:
        file["notes/name"] = file["notes/title"] = SECRET
        file["fixed"] = np.array([SECRET])
    return str(path)


WAYS: tuple[Callable[[h5py.File, str, Path], None], ...] = (_raw, _as_numbers, _link, _linked_group, _virtual)
FORMATS = {"exchange": "measurement/sample/name", "nxtomo": "entry/sample/name"}


def _scan(folder: Path, kind: str) -> Path:
    path = folder / "scan.h5"
    if kind == "exchange":
        return write_exchange(path, SCAN)
    write_flagged(path, frames_of(SCAN), {})
    return path


@pytest.mark.parametrize(
    ("kind", "way"), [(kind, way) for kind in FORMATS for way in WAYS if (kind, way) != ("nxtomo", _linked_group)]
)
def test_no_text_of_another_file_is_shown_or_copied_and_the_file_is_named(
    tmp_path: Path, kind: str, way: Callable[[h5py.File, str, Path], None]
) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "data").mkdir()
    secret = tmp_path / "home" / "secret"
    secret.write_bytes(SECRET)
    path, place = _scan(tmp_path / "data", kind), FORMATS[kind]
    with h5py.File(path, "r+") as file:
        file.pop(place, None)
        way(file, place, secret)
    copy = tmp_path / "copy.h5"
    said = list[str]()
    for work in (describe, lambda scan: ingest(scan, copy)):
        try:
            said.append(str(work(path)))
        except DataError as error:
            said.append(str(error))
    assert all("secret:" not in each and "home/secret" in each for each in said), said
    assert not copy.exists() or SECRET.strip() not in copy.read_bytes()


def test_text_beside_frames_and_numbers_beside_the_scan_are_read(tmp_path: Path) -> None:
    path = write_exchange(tmp_path / "scan.h5", SCAN)

    with h5py.File(path, "r+") as file, h5py.File(tmp_path / "frames.h5", "w") as other:
        other["frames"], other["name"] = np.ones((2, 3, 4), "u2"), b"cathode"
        theta = np.asarray(file["exchange/theta"][()], "f8") / 2
        theta.tofile(tmp_path / "theta.raw")
        del file["exchange/theta"]
        file.create_dataset(
            "exchange/theta", theta.shape, "f8", external=[(str(tmp_path / "theta.raw"), 0, theta.nbytes)]
        )
        file["exchange/theta"].attrs["units"] = "deg"
        file.pop("measurement/sample/name", None)
        file["measurement/sample/name"] = h5py.ExternalLink("frames.h5", "name")
    with open_scan(path) as source:
        assert source.attributes["sample"] == "cathode"
        np.testing.assert_allclose(np.degrees(source.angles[np.isfinite(source.angles)]), theta)
