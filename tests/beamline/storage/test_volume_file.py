"""Volume files: files of other programs are read; files that are not volumes end with an error by name."""

from __future__ import annotations

import gzip
import struct
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from PIL import Image

from beamline.core.errors import DataError
from beamline.storage.volume_file import read_volume
from tests.messages import refused

VALUES = np.arange(24, dtype=np.int16).reshape(2, 3, 4) - 5


def nifti(values: np.ndarray = VALUES, order: str = "<", **changed: object) -> bytes:
    """A NIfTI-1 file by hand, field after field as the standard's table lists them; `changed` by name."""
    codes = {"u1": (2, 8), "i2": (4, 16), "i4": (8, 32), "f4": (16, 32), "f8": (64, 64), "u2": (512, 16)}
    code, bits = codes[values.dtype.str[1:]]
    field: dict[str, Any] = {
        "size": 348,
        "dim": (3, *values.shape[::-1], 1, 1, 1, 1),
        "datatype": code,
        "bitpix": bits,
        "pixdim": (1.0, 0.5, 0.6, 0.7, 0.0, 0.0, 0.0, 0.0),
        "offset": 352.0,
        "slope": 0.0,
        "intercept": 0.0,
        "units": 2,
        "magic": b"n+1\0",
    } | changed
    header = struct.pack(
        f"{order}i35xB8h3fh2h h8f3fhBB4f2i80s24s2h6f12f16s4s",
        field["size"], 0, *field["dim"], 0.0, 0.0, 0.0, 0, field["datatype"], field["bitpix"], 0, *field["pixdim"],
        field["offset"], field["slope"], field["intercept"], 0, 0, field["units"], 0.0, 0.0, 0.0, 0.0, 0, 0,
        b"", b"", 0, 0, *[0.0] * 6, *[0.0] * 12, b"", field["magic"],
    )  # fmt: skip
    assert len(header) == 348
    return header + b"\0" * 4 + values.astype(np.dtype(f"{order}{values.dtype.str[1:]}")).tobytes()


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("dtype", ["u1", "i2", "i4", "f4", "f8", "u2"])
@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_nifti_is_read_whatever_its_type_and_byte_order(tmp_path: Path, order: str, dtype: str, suffix: str) -> None:
    values = np.arange(24).reshape(2, 3, 4).astype(dtype)
    path = tmp_path / f"v{suffix}"
    path.write_bytes(gzip.compress(nifti(values, order)) if suffix == ".nii.gz" else nifti(values, order))
    read, spacing = read_volume(path)
    np.testing.assert_array_equal(read, values)
    assert read.dtype == values.dtype and read.dtype.isnative
    assert spacing == pytest.approx((0.7, 0.6, 0.5))


def test_nifti_scales_values_and_lengths_as_its_header_says(tmp_path: Path) -> None:
    path = tmp_path / "v.nii"
    path.write_bytes(nifti(slope=2.0, intercept=-1000.0, units=3, offset=352.0))
    read, spacing = read_volume(path)
    np.testing.assert_array_equal(read, VALUES * 2.0 - 1000)
    assert spacing == pytest.approx((0.7e-3, 0.6e-3, 0.5e-3))
    path.write_bytes(nifti(units=1, pixdim=(1, -2, 3, 4, 0, 0, 0, 0)))  # a negative step says how the patient lies
    assert read_volume(path)[1] == pytest.approx((4e3, 3e3, 2e3))


def test_without_nibabel_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "v.nii").write_bytes(nifti())
    monkeypatch.setitem(sys.modules, "nibabel", None)
    with refused(DataError):
        read_volume(tmp_path / "v.nii")


def test_arrays_tiffs_and_hdf5_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", VALUES)
    np.savez(tmp_path / "v.npz", volume=VALUES, voxel_mm=np.float32(0.25), title="a walnut")
    np.savez(tmp_path / "two.npz", a=VALUES, b=VALUES + 1)
    tifffile.imwrite(tmp_path / "v.tif", VALUES, photometric="minisblack")
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file["entry/data/data"], file["entry/theta"] = VALUES, np.zeros(3)
    for name, spacing in (("v.npy", None), ("v.npz", (0.25,) * 3), ("v.tif", None), ("v.h5", None)):
        read, found = read_volume(tmp_path / name)
        np.testing.assert_array_equal(read, VALUES)
        assert found == spacing
    np.testing.assert_array_equal(read_volume(tmp_path / "two.npz", "b")[0], VALUES + 1)
    np.testing.assert_array_equal(read_volume(tmp_path / "v.h5", "entry/data/data")[0], VALUES)
    for name, dataset, said in (
        ("two.npz", None, r"contains 2 volumes \(a, b\)"),
        ("two.npz", "c", "has no array 'c'"),
        ("v.h5", "entry/data", "has no dataset 'entry/data'"),
        ("v.npy", "volume", "contains one volume"),
        ("none.npy", None, "does not exist"),
    ):
        with pytest.raises(DataError, match=said):
            read_volume(tmp_path / name, dataset)


@pytest.mark.parametrize("name", ["v.tif", "v.h5"])
def test_a_volume_that_memory_cannot_hold_is_refused_before_it_is_read(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    tifffile.imwrite(tmp_path / "v.tif", VALUES, photometric="minisblack")
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file["volume"] = VALUES
    read_volume(tmp_path / name)
    monkeypatch.setattr("beamline.storage.array_file.free_memory", lambda: VALUES.nbytes - 1)
    with pytest.raises(DataError, match=r"states 4\.8e-08 GB"):
        read_volume(tmp_path / name)


@pytest.mark.parametrize("name", ["v.tif", "v.npy", "v.npz", "v.h5", "v.jpg"])
def test_what_is_no_volume_file_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"no volume at all, but some text that is long enough for a header")
    with pytest.raises(DataError, match=r"cannot be read|not a readable|not a known volume file|HDF5"):
        read_volume(tmp_path / name)


@pytest.mark.parametrize(("unit", "edge"), [("micron", 1.0), ("\\u00B5m", 1.0), ("nm", 1000.0), ("mm", 0.001)])
def test_fiji_states_the_edges_of_a_voxel(tmp_path: Path, unit: str, edge: float) -> None:
    facts = {"axes": "ZYX", "spacing": 3 * edge, "unit": unit}
    tifffile.imwrite(
        tmp_path / "v.tif", np.ones((4, 5, 6), np.float32), imagej=True, resolution=(1 / edge,) * 2, metadata=facts
    )
    values, spacing = read_volume(tmp_path / "v.tif")
    assert values.shape == (4, 5, 6) and spacing == pytest.approx((0.003, 0.001, 0.001), rel=1e-3)


def test_ome_states_the_edges_of_a_voxel_and_a_bare_tiff_none(tmp_path: Path) -> None:
    edges = {"PhysicalSizeX": 0.5, "PhysicalSizeY": 0.5, "PhysicalSizeZ": 2.0, "PhysicalSizeZUnit": "µm"}
    tifffile.imwrite(
        tmp_path / "v.ome.tif",
        np.ones((4, 5, 6), np.uint16),
        photometric="minisblack",
        metadata={"axes": "ZYX", **edges},
    )
    assert read_volume(tmp_path / "v.ome.tif")[1] == pytest.approx((0.002, 0.0005, 0.0005))
    tifffile.imwrite(
        tmp_path / "bare.tif", np.ones((4, 5, 6), np.uint16), photometric="minisblack", resolution=(72, 72)
    )
    assert read_volume(tmp_path / "bare.tif")[1] is None


@pytest.mark.parametrize("suffix", ["png", "bmp", "PNG", "jpg", "tif"])
def test_slices_of_other_programs_are_a_volume_without_the_preview_beside_them(tmp_path: Path, suffix: str) -> None:
    slices = np.repeat(np.arange(11, dtype=np.uint8) * 20, 8 * 10).reshape(11, 8, 10)
    for z, one in enumerate(slices):
        Image.fromarray(one).save(tmp_path / f"rec_{z}.{suffix}")
    Image.fromarray(slices[0, :3]).save(tmp_path / f"rec_spr.{suffix}")
    for name, content in (
        ("rec_.log", "[Reconstruction]\nPixel Size (um)=7.95\n"),
        ("Thumbs.db", "x"),
        (".DS_Store", "x"),
    ):
        (tmp_path / name).write_text(content)
    values, spacing = read_volume(tmp_path)
    np.testing.assert_allclose(np.asarray(values, np.float64), slices, atol=2 * (suffix == "jpg"))
    assert spacing == pytest.approx((0.00795,) * 3)
    (tmp_path / "rec_.log").write_text("[2026-05-03] begun\n  taken\n")
    assert read_volume(tmp_path)[1] is None
    for z in range(2):
        Image.fromarray(slices[z]).save(tmp_path / f"other_{z}.{suffix}")
    with refused(DataError):
        read_volume(tmp_path)


def test_coloured_pictures_are_no_volume(tmp_path: Path) -> None:
    grey = np.full((4, 5, 3), 90, np.uint8)
    Image.fromarray(grey).save(tmp_path / "s_0.png")
    assert read_volume(tmp_path)[0].tolist() == [[[90] * 5] * 4]
    grey[1, 1, 0] = 200
    Image.fromarray(grey).save(tmp_path / "s_1.png")
    with refused(DataError):
        read_volume(tmp_path)


def test_slices_with_signed_numbers_and_voxels_that_are_no_squares_are_read(tmp_path: Path) -> None:
    for z in range(-3, 3):
        tifffile.imwrite(tmp_path / f"z{z}.tif", np.full((4, 5), 10 + z, np.uint8))
    assert read_volume(tmp_path)[0][:, 0, 0].tolist() == [7, 8, 9, 10, 11, 12]
    path, volume = tmp_path / "v.tif", np.ones((3, 4, 5), np.float32)
    facts = {"spacing": 2.0, "unit": "um", "axes": "ZYX"}
    tifffile.imwrite(path, volume, imagej=True, resolution=(2, 1.5), metadata=facts)
    assert read_volume(path)[1] is None
