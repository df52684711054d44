"""Packed numbers are read as the values that CF and CIL define, in any dataset, or end with an error by name."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.storage import datasets
from beamline.storage.readers.open import SourceOptions, open_scan

NAN = np.nan
int8, int16, uint16, float32 = (partial(np.array, dtype=kind) for kind in (np.int8, np.int16, np.uint16, np.float32))
CASES: dict[str, tuple[np.ndarray, dict[str, Any], list[float]]] = {
    "scale and offset": (int16([-2, 0, 3]), {"scale_factor": 0.5, "add_offset": 1.0}, [0, 1, 2.5]),
    "the other byte order": (np.array([-2, 3], ">i2"), {"scale_factor": np.float32(2)}, [-4, 6]),
    "fills": (uint16([1, 2, 9]), {"_FillValue": np.uint16(9), "missing_value": [2, -1]}, [1, NAN, NAN]),
    "a fill of reals": (float32([1, -9, NAN]), {"_FillValue": np.float32(-9), "scale_factor": 2.0}, [2, NAN, NAN]),
    "limits as stored": (int16([1, 5, 9]), {"valid_range": int16([2, 8]), "scale_factor": 10.0}, [NAN, 50, NAN]),
    "limits of values": (int16([1, 5, 9]), {"valid_range": [20.0, 80.0], "scale_factor": 10.0}, [NAN, 50, NAN]),
    "one limit": (int16([1, 5, 9]), {"valid_min": np.int16(5)}, [NAN, 5, 9]),
    "a negative scale": (int16([1, 5, 9]), {"valid_range": [-60.0, -20.0], "scale_factor": -10.0}, [NAN, -50, NAN]),
    "unsigned": (int8([1, -2, -1]), {"_Unsigned": "true", "_FillValue": np.int8(-1)}, [1, 254, NAN]),
}


@pytest.mark.parametrize("case", CASES)
def test_values_of_cf(tmp_path: Path, case: str) -> None:
    stored, attributes, values = CASES[case]
    with h5py.File(tmp_path / "a.nc", "w") as file:
        for name, array in (("list", stored), ("number", stored[1])):
            file.create_dataset(name, data=array, dtype=stored.dtype).attrs.update(attributes)
    with h5py.File(tmp_path / "a.nc") as file:
        item, number = datasets.dataset(file, "list"), datasets.dataset(file, "number")
        assert item is not None and number is not None
        assert (item.dtype, item.id.dtype, item[()].dtype) == (np.float32, stored.dtype, np.float32)
        np.testing.assert_allclose(item[()], values)
        np.testing.assert_allclose(item[1:], values[1:])
        np.testing.assert_allclose(number[()], values[1])


@pytest.mark.parametrize(
    "attributes",
    [
        {"scale_factor": 1.0, "add_offset": 0.0},
        {"valid_range": uint16([0, 65535])},
        {"offset": [1.0, 2.0, 3.0]},  # of NXtransformations
        {"scale": 1.0, "offset": 0.0},
        {"_FillValue": np.float32(NAN)},
    ],
)
def test_what_changes_nothing_leaves_the_type(tmp_path: Path, attributes: dict[str, Any]) -> None:
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file["a"] = np.arange(3, dtype=np.uint16)
        file["a"].attrs.update(attributes)
        item = datasets.dataset(file, "a")
        assert item is not None and item.dtype == np.uint16


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        ({"scale_factor": 0.0}, "scale_factor 0"),
        ({"scale_factor": "abc"}, "scale_factor 'abc'"),
        ({"scale_factor": [2.0, 3.0]}, "scale_factor 2. 3."),
        ({"add_offset": NAN}, "add_offset nan"),
        ({"scale": 2.0, "offset": 1.0}, "scale 2. and offset 1."),
    ],
)
def test_what_says_nothing_certain_is_refused_by_name(tmp_path: Path, attributes: dict[str, Any], said: str) -> None:
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file["a"] = np.arange(3)
        file["a"].attrs.update(attributes)
        with pytest.raises(DataError, match=f"/a in .*a.nc has the attributes .*{re.escape(said)}"):
            datasets.dataset(file, "a")


def test_every_dataset_of_a_scan_is_packed_for_itself(tmp_path: Path) -> None:
    images = np.random.default_rng(0).integers(0, 900, (3, 5, 4, 6)).astype(np.uint16)
    packed = {"data": (images[0], 2.0), "data_white": (images[1], 3.0), "data_dark": (images[2], 1.0)}
    with h5py.File(tmp_path / "s.h5", "w") as file:
        for name, (array, scale) in packed.items():
            file[f"exchange/{name}"] = array
            file[f"exchange/{name}"].attrs["scale_factor"] = scale
        file["exchange/theta"] = int16([0, 360, 720, 1080, 1440])
        file["exchange/theta"].attrs.update(units="deg", scale_factor=0.1)
    with open_scan(tmp_path / "s.h5") as source:
        assert (source.dtype, source.quantity) == (np.float32, "counts")
        for kind, (array, scale) in zip((0, 1, 2), packed.values(), strict=True):
            np.testing.assert_array_equal(source.read(source.table.of_kind(kind)), scale * array)
        np.testing.assert_allclose(np.degrees(source.table.angles[-5:]), [0, 36, 72, 108, 144])


def test_a_scan_of_cil_and_its_cone(tmp_path: Path) -> None:
    values, entry = np.random.default_rng(0).uniform(-1, 3, (9, 8, 12)), "/entry1/tomo_entry"
    scale = 65535 / np.ptp(values)
    with h5py.File(tmp_path / "s.nxs", "w") as file:
        file.attrs["creator"] = np.bytes_("NEXUSDataWriter.py")
        file[f"{entry}/data/data"] = np.rint((values - values.min()) * scale).astype(np.uint16)
        file[f"{entry}/data/data"].attrs.update(scale=scale, offset=-values.min() * scale, pixel_size_h=0.2)
        places = {
            "source/position": (0, -20, 0),
            "rotation_axis/position": (0, 0, 0),
            "detector/position": (0, 20, 0.4),
        }
        axes = {"detector/direction_x": (1, 0, 0), "detector/direction_y": (0, 0, 1)}
        for name, place in (places | axes).items():
            file[f"{entry}/config/{name}"] = float32(place)
        file[f"{entry}/config/angles"] = np.arange(9) * 40.0
        file[f"{entry}/config/angles"].attrs["angle_unit"] = "degree"
    options = SourceOptions(tmp_path / "s.nxs", data_path=f"{entry}/data/data", angles_path=f"{entry}/config/angles")
    with open_scan(options) as source:
        np.testing.assert_allclose(source.read(slice(None)), values, atol=1 / scale)
        np.testing.assert_allclose(
            np.degrees(source.table.angles), np.arange(9) * -40.0
        )  # of the view, not of the object
        assert (source.cone, source.pixel_size_mm) == ((20, 40), 0.2)
        assert source.central_ray == pytest.approx((3.5 - 0.4 / 0.2, 5.5))


@pytest.mark.parametrize("said", [False, True])
def test_sources_of_a_virtual_dataset_that_are_packed(tmp_path: Path, said: bool) -> None:
    """HDF5 gives their stored numbers: these are refused by name, unless the dataset itself says how they are read."""
    stored = np.arange(24, dtype=np.int16).reshape(2, 3, 4)
    layout = h5py.VirtualLayout((4, 3, 4), np.int16)
    for n in range(2):
        with h5py.File(tmp_path / f"part_{n}.h5", "w") as file:
            file["d"] = stored + n
            file["d"].attrs["scale_factor"] = 0.5
        layout[2 * n : 2 * n + 2] = h5py.VirtualSource(tmp_path / f"part_{n}.h5", "d", stored.shape)
    with h5py.File(tmp_path / "s.h5", "w") as file:
        whole = file.create_virtual_dataset("d", layout)
        whole.attrs.update({"scale_factor": 0.5} if said else {})
    scan = SourceOptions(tmp_path / "s.h5", data_path="d", angles=np.arange(4.0))
    if said:
        with open_scan(scan) as source:
            np.testing.assert_array_equal(source.read(slice(None)), 0.5 * np.concatenate([stored, stored + 1]))
    else:
        with pytest.raises(
            DataError, match=r"/d in .*s.h5 is a virtual.*d in .*part_0.h5, are packed \(attributes scale_factor"
        ):
            open_scan(scan)
