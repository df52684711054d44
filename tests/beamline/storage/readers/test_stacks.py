"""HDF5 files of any layout: their datasets are named, and nothing about them is guessed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.storage.readers.open import SourceOptions, open_scan

PATHS = {
    "data_path": "/raw/images",
    "darks_path": "/raw/before/dark",
    "flats_path": "/raw/before/flat",
    "angles_path": "/motors/omega",
}


@pytest.fixture
def images(rng: np.random.Generator) -> np.ndarray:
    """Two darks, three flats, five projections."""
    return rng.integers(0, 900, (10, 4, 6)).astype(np.uint16)


@pytest.fixture
def path(tmp_path: Path, images: np.ndarray) -> Path:
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["raw/images"], file["raw/before/dark"], file["raw/before/flat"] = images[5:], images[:2], images[2:5]
        file["motors/omega"] = np.linspace(0, np.pi, 5)
        file["motors/omega"].attrs["units"] = "rad"
        file["motors/plain"] = np.linspace(0, 180, 5)[:, None]
        file["motors/of_all"] = np.linspace(0, 450, 10)
        file["raw/before/one"] = images[0]
        file["note"] = "text"
    return tmp_path / "s.h5"


def test_darks_then_flats_then_projections(path: Path, images: np.ndarray) -> None:
    with open_scan(SourceOptions(path, **PATHS)) as source:
        assert (source.format, source.quantity, source.finished) == ("hdf5_stacks", "counts", True)
        assert source.image_key.tolist() == [2, 2, 1, 1, 1, 0, 0, 0, 0, 0]
        np.testing.assert_array_equal(source.read(slice(None)), images)
        np.testing.assert_array_equal(source.read([9, 0, 4], slice(1, 3)), images[[9, 0, 4], 1:3])
        np.testing.assert_allclose(source.angles[5:], np.linspace(0, np.pi, 5))
        assert np.isnan(source.angles[:5]).all()
        assert [frame.trigger for frame in source.frames()] == [0, 1, 0, 1, 2, 0, 1, 2, 3, 4]


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_a_unit_that_is_given_goes_before_the_file(path: Path, unit: str) -> None:
    for where, values in (("/motors/omega", np.linspace(0, np.pi, 5)), ("/motors/plain", np.linspace(0, 180, 5))):
        with open_scan(SourceOptions(path, **{**PATHS, "angles_path": where}, angles_unit=unit)) as source:
            expected = values if unit == "rad" else np.radians(values)
            np.testing.assert_allclose(source.angles[5:], expected)


def test_of_one_angle_for_each_frame_those_of_the_projections_are_named(path: Path) -> None:
    """Nothing says whether darks and flats were taken before the projections or after them."""
    said = {**PATHS, "angles_path": "/motors/of_all", "angles_unit": "deg"}
    with pytest.raises(DataError, match=r"10 angles.*--angle-rows"):
        open_scan(SourceOptions(path, **said))
    with open_scan(SourceOptions(path, **said, angle_rows="2:7")) as source:
        np.testing.assert_allclose(np.degrees(source.angles[5:]), np.linspace(0, 450, 10)[2:7])


def test_a_reference_may_be_a_single_image(path: Path, images: np.ndarray) -> None:
    with open_scan(SourceOptions(path, **{**PATHS, "darks_path": "/raw/before/one"})) as source:
        assert source.image_key.tolist() == [2, 1, 1, 1, 0, 0, 0, 0, 0]
        np.testing.assert_array_equal(source.read([0])[0], images[0])


def test_what_is_not_named_is_not_there(path: Path, images: np.ndarray) -> None:
    with open_scan(SourceOptions(path, data_path="raw/images")) as source:
        assert (source.quantity, source.image_key.tolist()) == ("unknown", [0] * 5)
        assert np.isnan(source.angles).all()
        np.testing.assert_array_equal(source.read(slice(None)), images[5:])


def test_angles_of_a_known_format_may_lie_elsewhere(path: Path, images: np.ndarray) -> None:
    with h5py.File(path, "r+") as file:
        file["exchange/data"] = file["raw/images"]
    with open_scan(SourceOptions(path, angles_path="/motors/omega")) as source:
        assert source.format == "data_exchange"
        np.testing.assert_allclose(source.angles, np.linspace(0, np.pi, 5))


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"data_path": "/raw/image"}, r"has no dataset /raw/image. It has /raw/images \(5 x 4 x 6\), .*/motors/omega"),
        ({"data_path": "/raw"}, "has no dataset /raw. It has"),
        ({"flats_path": "/flat"}, "has no dataset /flat. It has"),
        ({"angles_path": "/theta"}, "has no dataset /theta. It has"),
        ({"data_path": "/raw/before/one"}, r"expected frames \[frame, row, col\] of one shape"),
        ({"data_path": "/note"}, r"expected frames .* found .*/note \(\)"),
        ({"flats_path": "/motors/omega"}, r"expected frames .* found .*/motors/omega \(5,\)"),
        ({"angles_path": "/raw/before/one"}, r"is \(4, 6\); expected a list of angles"),
        ({"angles_path": "/note"}, "expected a list of angles"),
        ({"angles_path": "/motors/plain"}, "has no attribute `units`: give --angles-unit"),
        ({"angles_path": "/motors/of_all", "angles_unit": "deg", "darks_path": None}, "has 10 angles, but there are 5"),
        ({"angles": [0.0] * 5}, "--angles and --angles-path name the same thing twice"),
        ({"flats": np.ones((1, 4, 6))}, "--flats and --flats-path name the same thing twice"),
        ({"data_path": None}, "--darks-path goes with --data-path: give both, or neither"),
        ({"angles_path": None, "angles_unit": "rad"}, "--angles-unit goes with --angles-path: give both, or neither"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(path: Path, said: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message) as refused, open_scan(SourceOptions(path, **{**PATHS, **said})):
        pass
    assert "\n" not in str(refused.value)


def test_a_layout_that_is_not_known_says_what_the_file_has(path: Path) -> None:
    with pytest.raises(DataError, match=r"that is read.* /raw/images \(5 x 4 x 6\).*--data-path"):
        open_scan(path)
    with pytest.raises(DataError, match=r"--data-path, --angles-path:.*fit all frames"):
        open_scan(SourceOptions(path, **PATHS), follow=True)
    (path.parent / "s.txt").write_text("no")
    with pytest.raises(DataError, match="HDF5"):
        open_scan(SourceOptions(path.parent / "s.txt", **PATHS))
