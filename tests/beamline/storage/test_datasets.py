"""Datasets: filters that are not installed, and virtual datasets of many mappings, each of whose sources is opened
once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.validate import describe, validate
from beamline.storage import datasets
from beamline.storage.hdf5 import open_hdf5
from beamline.storage.readers.open import open_scan
from tests.beamline.storage.readers import foreign_scans

JPEG, NOBODY = 32019, 32999


def filtered(group: h5py.Group, name: str, *filters: int | str, skipped: bool = False) -> None:
    """The dataset stored anew by filters that nobody here has: its chunks are bytes that they alone could read."""
    values, made = group[name][()], h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    made.set_chunk((1, *values.shape[1:]))
    for each in filters:
        made.set_shuffle() if each == "shuffle" else made.set_filter(each, h5py.h5z.FLAG_OPTIONAL, ())
    del group[name]
    space = h5py.h5s.create_simple(values.shape)
    item = h5py.h5d.create(group.id, name.encode(), h5py.h5t.py_create(values.dtype), space, made)
    for i, value in enumerate(values):
        stored = np.ascontiguousarray(value).tobytes() if skipped else b"any bytes"
        item.write_direct_chunk((i, *(0,) * value.ndim), stored, filter_mask=int(skipped))


@pytest.mark.parametrize(
    ("name", "filters", "said"),
    [
        ("data", (JPEG,), "32019 (JPEG)"),
        ("data", ("shuffle", NOBODY), "32999 (name unknown)"),
        ("data_white", (JPEG,), "JPEG"),
        ("data_dark", (JPEG,), "JPEG"),
        ("theta", (NOBODY,), "32999"),
    ],
)
def test_a_filter_that_is_not_installed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, filters: Any, said: str
) -> None:
    monkeypatch.setenv("HDF5_PLUGIN_PATH", "/its/plugins")
    path = foreign_scans.exchange(tmp_path / "scan.h5")
    with h5py.File(path, "r+") as file:
        filtered(file["exchange"], name, *filters)
        file["exchange/theta"].attrs["units"] = "deg"
    with pytest.raises(DataError) as refused:
        describe(path)
    (found,) = [each.message for each in validate(path) if each.severity == "error"]
    for sentence in (found, str(refused.value)):
        assert f"/exchange/{name} in {path}" in sentence and said in sentence and "(now /its/plugins)" in sentence


def test_a_filter_behind_a_link_or_a_virtual_dataset_is_named_with_its_file(tmp_path: Path) -> None:
    source = foreign_scans.exchange(tmp_path / "source.h5")
    with h5py.File(source, "r+") as file:
        filtered(file["exchange"], "data", JPEG)
        shape = file["exchange/data"].shape
    drawn = h5py.VirtualLayout(shape, np.uint16)
    drawn[:] = h5py.VirtualSource("source.h5", "exchange/data", shape)
    for name, put in (("link", None), ("virtual", drawn)):
        path = foreign_scans.exchange(tmp_path / f"{name}.h5")
        with h5py.File(path, "r+") as file:
            del file["exchange/data"]
            if put is None:
                file["exchange/data"] = h5py.ExternalLink("source.h5", "exchange/data")
            else:
                file["exchange"].create_virtual_dataset("data", put)
        with open_scan(path) as scan, pytest.raises(DataError, match=r"source\.h5 .* 32019 \(JPEG\)"):
            scan.read([3])


def test_chunks_that_an_absent_filter_has_skipped_are_read(tmp_path: Path) -> None:
    path = foreign_scans.exchange(tmp_path / "scan.h5")
    with h5py.File(path, "r+") as file:
        filtered(file["exchange"], "data", JPEG, skipped=True)
    with open_scan(path) as scan:
        np.testing.assert_array_equal(scan.read([2, 3]), foreign_scans.FRAMES[foreign_scans.KEY == 0][:2])


def virtual(path: Path, name: str, *parts: tuple[str, slice], n: int = 8) -> None:
    layout = h5py.VirtualLayout((n, 2, 3), np.uint16)
    for source, rows in parts:
        layout[rows] = h5py.VirtualSource(source, "d", (n, 2, 3))[rows]
    with h5py.File(path / name, "w") as file:
        file.create_virtual_dataset("d", layout)


def test_a_source_is_opened_once_however_often_it_is_drawn_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mapping a frame, and a tree of files each of which draws twice on the next, which has 2^12 ways to its end."""
    with h5py.File(tmp_path / "0.h5", "w") as file:
        file["d"] = np.arange(48, dtype=np.uint16).reshape(8, 2, 3)
    virtual(tmp_path, "frames.h5", *(("0.h5", slice(i, i + 1)) for i in range(8)))
    for k in range(12):
        virtual(tmp_path, f"{k + 1}.h5", (f"{k}.h5", slice(0, 4)), (f"{k}.h5", slice(4, 8)))
    opened, really = list[str](), open_hdf5
    monkeypatch.setattr(datasets, "open_hdf5", lambda path: opened.append(path.name) or really(path))
    for name, times in (("frames.h5", 1), ("12.h5", 12)):
        opened.clear()
        with h5py.File(tmp_path / name) as file:
            assert datasets.missing_links(file["d"]) == [] and len(opened) == times
            np.testing.assert_array_equal(file["d"][7], np.arange(42, 48).reshape(2, 3))
    (tmp_path / "5.h5").unlink()
    with h5py.File(tmp_path / "12.h5") as file:
        assert datasets.missing_links(file["d"]) == [str(tmp_path / "11.h5")]
    virtual(tmp_path, "5.h5", ("12.h5", slice(0, 8)))  # a circle
    with h5py.File(tmp_path / "12.h5") as file:
        assert datasets.missing_links(file["d"]) == [str(tmp_path / "11.h5")]


@pytest.mark.parametrize(("packed", "free", "refused"), [("gzip", 1e3, True), ("gzip", 1e6, False), (None, 1e3, False)])
def test_a_chunk_that_the_memory_cannot_unpack_is_refused_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, packed: str | None, free: float, refused: bool
) -> None:
    monkeypatch.setattr(datasets, "HELD", 100)
    monkeypatch.setattr(datasets, "free_memory", lambda: free)
    path = foreign_scans.exchange(tmp_path / "scan.h5")
    with h5py.File(path, "r+") as file:
        frames = np.repeat(file["exchange/data"][()], 10, axis=1)
        for name in ("data", "data_white", "data_dark"):
            of = frames if name == "data" else frames[:1]
            del file[f"exchange/{name}"]
            file["exchange"].create_dataset(name, data=of, chunks=of.shape, compression=packed)
    if refused:
        with pytest.raises(
            DataError, match=r"chunks of 2\.4 kB: unpacking one chunk needs 4\.8 kB of memory, and 1 kB are free"
        ):
            open_scan(path)
    else:
        with open_scan(path) as scan:
            assert scan.unpack_bytes == (2 * frames.nbytes if packed else 0)
            np.testing.assert_array_equal(scan.read([2])[0], frames[0])
