"""One scan, whatever the order of its dimensions, of which some may have length one, and whatever keeps it."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import zarr

from beamline.core.errors import DataError
from beamline.features.files.validate import describe, validate
from beamline.storage.readers.open import SourceOptions, open_scan

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
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["d"] = sinogram
    scans = [SourceOptions(tmp_path / name, angles=ANGLES) for name in ("s.npy", "one.npy", "s.tif")]
    for scan in (*scans, SourceOptions(tmp_path / "s.h5", data_path="d", angles=ANGLES)):
        with open_scan(scan) as source:
            np.testing.assert_array_equal(source.read(slice(None)), VIEWS[:, 1:2])
            np.testing.assert_array_equal(source.table.angles, ANGLES)


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
            "4 angles: whether its rows or its columns are the views is not known. Give --order view,col",
        ),
        ((3, 5, 4), None, 5, "If each image is a sinogram of 5 views, say --order row,view,col"),
        ((3, 4, 5), None, 5, "If each image is a sinogram of 5 views, say --order row,col,view"),
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
        with pytest.raises(DataError, match=r"Frame 2 of / in .* cannot be read"):
            source.read([2])
