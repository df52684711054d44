"""The same scan with its dimensions in any order, some of length one, in any container."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from PIL import Image

from beamline.core.errors import DataError
from beamline.core.sinks import Note
from beamline.features.files.validate import describe, validate
from beamline.projections.selection import Selection
from beamline.projections.views import checked_views, select
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.rules.stored_order import SINOGRAM
from tests.messages import refused

VIEWS = np.arange(5 * 3 * 4, dtype=np.float32).reshape(5, 3, 4)
NAMES = ("view", "row", "col")
ANGLES = np.linspace(0, 3, 5)
ORDERS = [*permutations(range(3))]


@pytest.mark.parametrize("order", ORDERS, ids=lambda order: ",".join(NAMES[axis] for axis in order))
def test_an_order_of_dimensions_is_one_scan_in_any_file(tmp_path: Path, order: tuple[int, ...]) -> None:
    stored, named = VIEWS.transpose(order), ",".join(NAMES[axis] for axis in order)
    np.save(tmp_path / "s.npy", stored)
    tifffile.imwrite(tmp_path / "s.tif", stored, photometric="minisblack")
    (tmp_path / "folder").mkdir()
    for n, image in enumerate(stored):
        tifffile.imwrite(tmp_path / "folder" / f"s_{n}.tif", image, compression="zlib")
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["d"] = stored
    scans = [SourceOptions(tmp_path / name, order=named) for name in ("s.npy", "s.tif", "folder")]
    scans += [SourceOptions(tmp_path / "s.h5", data_path="d", order=named)]
    scans += [SourceOptions(tmp_path / "s.h5", data_path=f"d:{named}")]
    for scan in scans:
        with open_scan(scan) as source:
            np.testing.assert_array_equal(source.read([4, 0, 1]), VIEWS[[4, 0, 1]])
            np.testing.assert_array_equal(source.read(slice(1, 3), slice(1, 3)), VIEWS[1:3, 1:3])


@pytest.mark.parametrize("at", range(4))
def test_a_dimension_of_one_is_none(tmp_path: Path, at: int) -> None:
    """As detectors write [frame, 1, row, col], and [frame, row, col, 1]."""
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["d"], file["w"], file["k"] = np.expand_dims(VIEWS, at), VIEWS[:2, None], VIEWS[None, 0]
    with open_scan(SourceOptions(tmp_path / "s.h5", data_path="d", flats_path="w", darks_path="k")) as source:
        assert source.table.kinds.tolist() == [2, 1, 1, 0, 0, 0, 0, 0]
        np.testing.assert_array_equal(source.read(slice(3, None)), VIEWS)


@pytest.mark.parametrize("turned", [False, True])
def test_one_image_with_as_many_rows_or_columns_as_angles_is_a_sinogram(tmp_path: Path, turned: bool) -> None:
    sinogram = VIEWS[:, 1].T if turned else VIEWS[:, 1]
    np.save(tmp_path / "s.npy", sinogram)
    np.save(tmp_path / "one.npy", sinogram[None])
    tifffile.imwrite(tmp_path / "s.tif", sinogram)
    Image.fromarray(sinogram.astype(np.uint16)).save(tmp_path / "s.png")
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["d"] = sinogram
    np.save(tmp_path / "columns.npy", VIEWS[:, 1].T[..., None])
    names = ("s.npy", "one.npy", "s.tif", "s.png", "columns.npy")
    scans = [SourceOptions(tmp_path / name, angles=ANGLES) for name in names]
    for scan in (*scans, SourceOptions(tmp_path / "s.h5", data_path="d", angles=ANGLES)):
        with open_scan(scan) as source:
            np.testing.assert_array_equal(source.read(slice(None)), VIEWS[:, 1:2])
            np.testing.assert_array_equal(source.table.angles, ANGLES)


@pytest.mark.parametrize(("turned", "other"), [(False, "--order col,view"), (True, "--order view,col")])
def test_a_sinogram_is_said_to_be_one(tmp_path: Path, turned: bool, other: str) -> None:
    rng = np.random.default_rng(0)
    sinogram = rng.uniform(1, 2, (20, 9)).astype(np.float32)
    np.save(tmp_path / "s.npy", sinogram.T if turned else sinogram)
    with open_scan(SourceOptions(tmp_path / "s.npy", angles=np.arange(20) * 0.1, quantity="line_integrals")) as source:
        sentences = list[str]()
        checked_views(select(source, Selection()), sentences.append)
    (said,) = [each for each in sentences if "sinogram" in each]
    assert isinstance(said, Note) and "20 projections and 9 columns" in said and other in said


def test_a_sinogram_of_data_exchange_is_said_to_be_one(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["exchange/data"], file["exchange/theta"] = VIEWS[:, 0].T.astype(np.uint16), np.arange(5) * 30
        file["exchange/data"].attrs["axes"] = "x:theta"
    (said,) = [each.message for each in validate(tmp_path / "s.h5") if each.rule == SINOGRAM]
    assert "5 projections and 4 columns" in said and "/exchange/data to theta:x" in said


@pytest.mark.parametrize("packed", [np.savez, np.savez_compressed])
def test_an_npz_is_read_by_its_names(tmp_path: Path, packed: Callable[..., None]) -> None:
    """Without pickle; the only array of images needs no name."""
    packed(tmp_path / "s.npz", projections=VIEWS, angles=ANGLES)
    packed(tmp_path / "refs.npz", flat=VIEWS[:2] + 1, dark=VIEWS[0])
    references = {f"{name}s": f"{tmp_path / 'refs.npz'}::{name}" for name in ("flat", "dark")}
    for own in ({}, {"data_path": "projections"}):
        scan = SourceOptions(tmp_path / "s.npz", angles_path="angles", angles_unit="rad", **own, **references)  # type: ignore[arg-type]
        with open_scan(scan) as source:
            assert source.table.kinds.tolist() == [2, 1, 1, 0, 0, 0, 0, 0]
            np.testing.assert_array_equal(source.read(slice(1, None)), np.concatenate([VIEWS[:2] + 1, VIEWS]))
            np.testing.assert_allclose(source.table.angles[3:], ANGLES)
    with refused(DataError):
        open_scan(SourceOptions(tmp_path / "s.npz", data_path="b"))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "s.npz").read_bytes()[:300])
    with refused(DataError):
        open_scan(SourceOptions(tmp_path / "cut.npz", angles=ANGLES))


@pytest.mark.parametrize("name", ["s.npy", "s.npz"])
def test_objects_of_python_are_refused_as_pickles(tmp_path: Path, name: str) -> None:
    (np.save if name == "s.npy" else np.savez)(tmp_path / name, np.array([{}], object))
    with pytest.raises(DataError, match=r"numpy.save.*Python objects among its arrays.*pickles"):
        open_scan(SourceOptions(tmp_path / name, angles=ANGLES))


def test_what_is_no_sinogram_of_so_many_angles_is_said(tmp_path: Path) -> None:
    np.save(tmp_path / "s.npy", VIEWS[:, 1])
    with refused(DataError):
        open_scan(SourceOptions(tmp_path / "s.npy", angles=np.arange(9.0)))


def test_lists_of_a_file_that_may_be_its_angles_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "s.npz", projections=VIEWS, theta=ANGLES, x=np.arange(4))
    (said,) = [
        hit.message
        for hit in validate(SourceOptions(tmp_path / "s.npz", data_path="projections"))
        if hit.rule == "angles"
    ]
    assert "--angles-path /theta uses those of /theta" in said


def test_angles_of_an_array_file_are_taken_in_the_unit_in_which_they_go_round(tmp_path: Path) -> None:
    for degrees, taken in ((np.arange(6) * 60.0, True), (np.arange(6) * 30.0, True), (np.arange(6) * 7.0, False)):
        for name, values in (("deg", degrees), ("rad", np.radians(degrees))):
            np.savez(path := tmp_path / f"{name}.npz", projections=np.zeros((6, 4, 5)), theta=values, x=np.arange(6))
            with open_scan(path) as source:
                expected = np.radians(degrees) if taken else np.full(6, np.nan)
                np.testing.assert_allclose(source.table.angles, expected)


def test_references_of_one_row_are_lines(tmp_path: Path) -> None:
    counts = VIEWS.astype(np.uint16)
    for name, lines in (("s", counts[:, 0]), ("w", counts[:3, 1]), ("k", counts[:1, 2])):
        np.save(tmp_path / f"{name}.npy", lines)
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["exchange/data"], file["exchange/data_white"] = counts[:, 0], counts[:3, 1]
        file["exchange/data_dark"], file["exchange/theta"] = counts[:1, 2], np.linspace(0, 170, 5)
    apart = SourceOptions(tmp_path / "s.npy", angles=ANGLES, flats=tmp_path / "w.npy", darks=tmp_path / "k.npy")
    for scan in (apart, SourceOptions(tmp_path / "s.h5")):
        with open_scan(scan) as source:
            assert source.table.kinds.tolist() == [2, 1, 1, 1, 0, 0, 0, 0, 0]
            expected = np.concatenate([counts[:1, 2], counts[:3, 1], counts[:, 0]])[:, None]
            np.testing.assert_array_equal(source.read(slice(None)), expected)


@pytest.mark.parametrize(
    ("shape", "order", "n", "message"),
    [
        (
            (4, 4),
            None,
            4,
            "Give --order view,col or .*there are 4 angles it is a sinogram, but either its rows or its columns",
        ),
        ((3, 5, 4), None, 5, "If each image is a sinogram of 5 projections, give --order row,view,col"),
        ((3, 4, 5), None, 5, "If each image is a sinogram of 5 projections, give --order row,col,view"),
        ((3, 5, 4), "view,col", 5, "--order view,col does not fit .* 3 images of 5 x 4 pixels"),
        ((3, 5, 4), "row,row,col", 5, "dimensions are given as row,row,col; expected"),
    ],
)
def test_what_no_order_tells_is_asked_for(
    tmp_path: Path, shape: tuple[int, ...], order: str | None, n: int, message: str
) -> None:
    np.save(tmp_path / "s.npy", np.zeros(shape))
    with pytest.raises(DataError, match=message):
        open_scan(SourceOptions(tmp_path / "s.npy", order=order, angles=np.linspace(0, 3, n)))


def test_an_npy_is_a_volume_until_the_caller_says_that_it_is_a_scan(tmp_path: Path) -> None:
    np.save(tmp_path / "s.npy", VIEWS)
    np.savetxt(tmp_path / "a.txt", np.degrees(ANGLES))
    assert describe(tmp_path / "s.npy")["format"] == "volume, npy"
    scan = SourceOptions(tmp_path / "s.npy", angles=tmp_path / "a.txt", quantity="line_integrals")
    assert describe(scan)["kinds"] == {"projection": 5}
    assert [each.rule for each in validate(tmp_path / "s.npy")] == ["voxel-size"]
    assert "pixel-size" in [each.rule for each in validate(scan)]


def test_a_zarr_is_read_as_hdf5_is(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "s.h5", "w") as file:
        for create in (file.create_dataset, zarr.open_group(tmp_path / "s.zarr", mode="w").create_array):
            for name, values in (("data", VIEWS), ("data_white", VIEWS[:2]), ("theta", ANGLES)):
                item = create(f"exchange/{name}", data=values)
                item.attrs["units"] = "rad" if name == "theta" else "counts"
    found = []
    for name in ("s.h5", "s.zarr"):
        with open_scan(tmp_path / name) as source:
            found.append(
                (source.format, source.quantity, source.table.kinds.tolist(), source.table.angles[2:].tolist())
            )
            np.testing.assert_array_equal(source.read(slice(2, None)), VIEWS)
    assert found[0] == found[1]


def test_a_damaged_chunk_of_a_zarr_is_named(tmp_path: Path) -> None:
    zarr.create_array(tmp_path / "s.zarr", data=VIEWS, chunks=(1, 3, 4))
    (tmp_path / "s.zarr" / "c" / "2" / "0" / "0").write_bytes(b"no chunk")
    with open_scan(tmp_path / "s.zarr") as source:
        np.testing.assert_array_equal(source.read([1, 3]), VIEWS[[1, 3]])
        with refused(DataError):
            source.read([2])
