"""HDF5 files of any layout: their datasets are named, nothing is guessed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.stored_order import axis_vertical
from tests.messages import refused

PATHS: dict[str, Any] = {
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


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_a_unit_that_is_given_goes_before_the_file(path: Path, unit: str) -> None:
    for where, values in (("/motors/omega", np.linspace(0, np.pi, 5)), ("/motors/plain", np.linspace(0, 180, 5))):
        with open_scan(SourceOptions(path, **{**PATHS, "angles_path": where}, angles_unit=unit)) as source:
            expected = values if unit == "rad" else np.radians(values)
            np.testing.assert_allclose(source.table.angles[5:], expected)


def test_a_reference_may_be_a_single_image(path: Path, images: np.ndarray) -> None:
    with open_scan(SourceOptions(path, **{**PATHS, "darks_path": "/raw/before/one"})) as source:
        assert source.table.kinds.tolist() == [2, 1, 1, 1, 0, 0, 0, 0, 0]
        np.testing.assert_array_equal(source.read([0])[0], images[0])


def test_what_is_not_named_is_not_there(path: Path, images: np.ndarray) -> None:
    with open_scan(SourceOptions(path, data_path="raw/images")) as source:
        assert (source.quantity, source.table.kinds.tolist()) == ("unknown", [0] * 5)
        assert np.isnan(source.table.angles).all()
        np.testing.assert_array_equal(source.read(slice(None)), images[5:])


def test_angles_of_a_known_format_may_lie_elsewhere(path: Path, images: np.ndarray) -> None:
    with h5py.File(path, "r+") as file:
        file["exchange/data"] = file["raw/images"]
        file["motors/text"] = [f"{angle} deg" for angle in np.linspace(0, 180, 5)]
    for where in ("/motors/omega", "/motors/text"):
        with open_scan(SourceOptions(path, angles_path=where)) as source:
            assert source.format == "data_exchange"
            np.testing.assert_allclose(source.table.angles, np.linspace(0, np.pi, 5))


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"data_path": "/raw/image"}, r"has no dataset /raw/image. It has /raw/images \(5 x 4 x 6\), .*/motors/omega"),
        ({"data_path": "/raw"}, "has no dataset /raw. It has"),
        ({"flats_path": "/flat"}, "has no dataset /flat. It has"),
        ({"angles_path": "/theta"}, "has no dataset /theta. It has"),
        ({"data_path": "/raw/before/one"}, r"expected frames \[frame, row, col\] with equal numbers"),
        ({"data_path": "/note"}, r"expected frames .* found .*/note \(\)"),
        ({"flats_path": "/motors/omega"}, r"expected frames .* found .*/motors/omega \(5,\)"),
        ({"angles_path": "/raw/before/one"}, r"has the shape \(4, 6\); expected a list of angles"),
        ({"angles_path": "/note"}, "expected a list of angles"),
        ({"angles_path": "/motors/plain"}, "has no attribute units; .* --angles-unit deg or rad"),
        ({"angles_path": "/motors/of_all", "angles_unit": "deg", "darks_path": None}, "has 10 angles, but 5"),
        ({"angles": [0.0] * 5}, "--angles and --angles-path state the same thing"),
        ({"flats": np.ones((1, 4, 6))}, "--flats and --flats-path state the same thing"),
        ({"data_path": None}, "--darks-path requires --data-path: give both, or neither"),
        ({"angles_path": None, "angles_unit": "rad"}, "--angles-unit requires --angles-path: give both, or neither"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(path: Path, said: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message) as refused, open_scan(SourceOptions(path, **{**PATHS, **said})):
        pass
    assert "\n" not in str(refused.value)


def test_a_layout_that_is_not_known_says_what_the_file_has(path: Path) -> None:
    with refused(DataError):
        open_scan(path)
    with refused(DataError):
        open_scan(SourceOptions(path, **PATHS), follow=True)
    (path.parent / "s.txt").write_text("no")
    with pytest.raises(DataError, match="HDF5"):
        open_scan(SourceOptions(path.parent / "s.txt", **PATHS))


ORDERS = {"view,row,col": (0, 1, 2), "view,col,row": (0, 2, 1), "row,view,col": (1, 0, 2), "row,col,view": (1, 2, 0),
          "col,view,row": (2, 0, 1), "col,row,view": (2, 1, 0)}  # fmt: skip


def _stored(path: Path, images: np.ndarray, order: tuple[int, ...], matlab: bool, one: bool = False) -> Path:
    """Projections, darks and flats whose dimensions are in this order; `one`: a single dark and flat."""
    with h5py.File(path, "w") as file:
        for name, part in (("images", images[5:]), ("dark", images[:2]), ("flat", images[2:5])):
            file[name] = (
                part[0].transpose([n - 1 for n in order if n]) if one and name != "images" else part.transpose(order)
            )
            if matlab:
                file[name].attrs["MATLAB_class"] = np.bytes_("uint16")
        file["omega"] = np.linspace(0, 180, 5)[None]
    return path


def _options(path: Path, dimensions: str = "") -> SourceOptions:
    names: dict[str, Any] = {"darks_path": "dark", "flats_path": "flat", "angles_path": "omega", "angles_unit": "deg"}
    return SourceOptions(path, data_path=f"/images{dimensions}", **names)


@pytest.mark.parametrize("one", [False, True])
@pytest.mark.parametrize("dimensions", ORDERS)
def test_dimensions_that_are_named(tmp_path: Path, images: np.ndarray, dimensions: str, one: bool) -> None:
    path = _stored(tmp_path / "s.h5", images, ORDERS[dimensions], False, one)
    with open_scan(_options(path, f":{dimensions}")) as source:
        expected = images[[0, 2, 5, 6, 7, 8, 9]] if one else images
        np.testing.assert_array_equal(source.read(slice(None)), expected)
        np.testing.assert_array_equal(source.read([1], slice(1, 3)), expected[[1], 1:3])


@pytest.mark.parametrize("one", [False, True])
@pytest.mark.parametrize(
    ("dimensions", "matlab"),
    [
        *(("view,row,col", False), ("row,view,col", False), ("row,col,view", False)),
        *(("view,col,row", True), ("col,row,view", True)),  # (row, col, view) and (view, row, col) in MATLAB
        ("row,view,col", True),  # sinograms (col, view, row)
    ],
)
def test_dimensions_that_shapes_tell(
    tmp_path: Path, images: np.ndarray, dimensions: str, matlab: bool, one: bool
) -> None:
    with open_scan(_options(_stored(tmp_path / "s.mat", images, ORDERS[dimensions], matlab, one))) as source:
        np.testing.assert_array_equal(source.read(slice(5 - 3 * one, None)), images[5:])
        np.testing.assert_array_equal(source.read([0])[0], images[0])


@pytest.mark.parametrize("store", ["stacks", "exchange"])
def test_the_advice_for_exchanged_rows_and_columns_gives_no_mirror_image(tmp_path: Path, store: str) -> None:
    angles, place = np.arange(60) * 3.0, np.arange(24) - 11.5
    t = np.radians(angles)[:, None, None]
    shadow = np.exp(-((place - 5 * np.cos(t)) ** 2 + (place[:, None] - 3) ** 2) / 8)
    views = np.round(4e4 * np.exp(-shadow)).astype(np.uint16)
    names = {"stacks": ("proj", "dark", "flat"), "exchange": ("data", "data_dark", "data_white")}[store]
    with h5py.File(tmp_path / "s.h5", "w") as file:
        group = file if store == "stacks" else file.create_group("exchange")
        stacks = views, np.zeros((2, 24, 24), "u2"), np.full((2, 24, 24), 40_000, "u2")
        for name, part in zip(names, stacks, strict=True):
            group[name] = part.transpose(0, 2, 1)
        group["theta"] = angles
        group["theta"].attrs["units"] = "deg"
    given: dict[str, Any] = {"darks_path": "dark", "flats_path": "flat", "angles_path": "theta", "data_path": "proj"}
    with open_scan(SourceOptions(tmp_path / "s.h5", **(given if store == "stacks" else {}))) as source:
        (finding,) = axis_vertical(ScanEvidence(source))
    options = dict(re.findall(r"--(\w+)-path ([\w/,:]+\w)", finding.message))
    given |= {f"{name}_path": where for name, where in options.items()}
    with open_scan(SourceOptions(tmp_path / "s.h5", **given)) as source:
        np.testing.assert_array_equal(source.read(slice(4, None)), views)
        assert not [*axis_vertical(ScanEvidence(source))]
