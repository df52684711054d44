"""Darks and flats can be read from any kind of file, with the same result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.reference_files import load_images
from drivers.base.frame import FrameKind
from tests.messages import refused

SHAPE = (6, 8)
IMAGES = np.random.default_rng(3).integers(0, 60000, (4, *SHAPE)).astype(np.uint16)
OTHERS = IMAGES[::-1] + 1


def _alone(file: h5py.File) -> None:
    file["1-TempPlugin-tomo/data"] = IMAGES  # httomo, Savu: data and nothing else of this shape
    file["1-TempPlugin-tomo/time"] = np.arange(4.0)


def _keyed(file: h5py.File, keys: list[int]) -> None:
    frames, n = np.empty((len(keys), *SHAPE), np.uint16), 0
    for i, key in enumerate(keys):
        frames[i] = IMAGES[n] if key == FrameKind.DARK else OTHERS[i % 4]
        n += key == FrameKind.DARK
    detector = file.create_group("entry1/tomo_entry/instrument/detector")
    detector["data"], detector["image_key"] = frames, np.array(keys)


def _unset(file: h5py.File) -> None:
    detector = file.create_group("entry/instrument/detector")
    detector["data"], detector["image_key"] = IMAGES, np.zeros(4, int)


def _exchange(file: h5py.File) -> None:
    file["exchange/data"], file["exchange/data_white"], file["exchange/data_dark"] = OTHERS, OTHERS, IMAGES


def _linked(file: h5py.File) -> None:
    with h5py.File(Path(file.filename).with_name("detector.h5"), "w") as other:
        other["data"] = IMAGES
    file["entry/instrument/detector/data"] = h5py.ExternalLink("detector.h5", "/data")  # i12: frames beside
    file["entry/data/data"] = h5py.SoftLink("/entry/instrument/detector/data")


LAYOUTS: dict[str, Callable[[h5py.File], None]] = {
    "alone": _alone,
    "only darks by image_key": lambda file: _keyed(file, [2, 2, 2, 2]),
    "darks among others by image_key": lambda file: _keyed(file, [1, 2, 2, 0, 0, 2, 1, 2]),
    "an image_key that nobody set": _unset,
    "data exchange": _exchange,
    "linked": _linked,
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("suffix", [".h5", ".nxs", ".hdf"])
def test_they_are_found_in_any_layout(tmp_path: Path, layout: str, suffix: str) -> None:
    path = tmp_path / f"darks{suffix}"
    with h5py.File(path, "w") as file:
        LAYOUTS[layout](file)
    np.testing.assert_array_equal(load_images(path, FrameKind.DARK, SHAPE), IMAGES)
    tifffile.imwrite(tmp_path / "views.tif", OTHERS, photometric="minisblack")
    with open_scan(SourceOptions(tmp_path / "views.tif", darks=path, flats=IMAGES[:1])) as source:
        assert source.table.kinds.tolist() == [2] * 4 + [1] + [0] * 4 and source.quantity == "counts"
        np.testing.assert_array_equal(source.read(range(4)), IMAGES)


def test_one_of_several_is_named_and_a_single_image_is_one_frame(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with h5py.File(path, "w") as file:
        file["a/dark"], file["a/flat"] = IMAGES, OTHERS[0]
    np.testing.assert_array_equal(load_images(f"{path}::/a/dark", FrameKind.DARK), IMAGES)
    np.testing.assert_array_equal(load_images(f"{path}::a/flat", FrameKind.FLAT), OTHERS[:1])
    with refused(DataError):
        load_images(path, FrameKind.DARK, SHAPE)
    with refused(DataError):
        load_images(f"{path}::/b", FrameKind.DARK)
    with refused(DataError):
        load_images(path, FrameKind.FLAT, (9, 9))


def test_what_is_no_images_is_refused(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("1 2 3")
    with pytest.raises(DataError, match="as images of one shape"):
        load_images(tmp_path / "t.txt", FrameKind.DARK)
    tifffile.imwrite(tmp_path / "t.tif", IMAGES, photometric="minisblack")
    with pytest.raises(DataError, match="not an HDF5 file"):
        load_images(f"{tmp_path / 't.tif'}::/a", FrameKind.DARK)
    with h5py.File(tmp_path / "v.h5", "w") as file:
        drawn = h5py.VirtualLayout(IMAGES.shape, np.uint16)
        drawn[:] = h5py.VirtualSource("gone.h5", "data", IMAGES.shape)
        file.create_virtual_dataset("data", drawn)
    with refused(DataError):
        load_images(tmp_path / "v.h5", FrameKind.DARK)


def test_a_number_stands_for_darks_of_every_pixel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    darks = load_images("300", FrameKind.DARK, (2, 3))
    assert (darks.tolist(), darks.dtype) == ([[[300] * 3] * 2], np.uint16)
    tifffile.imwrite("300", np.full((2, 3), 7, np.uint16))
    assert load_images("300", FrameKind.DARK, (2, 3)).max() == 7
    with refused(DataError):
        load_images("301.5", FrameKind.DARK, (2, 3))


@pytest.mark.parametrize("first", [0, 10])
def test_flats_of_several_places_stand_where_they_were_taken(tmp_path: Path, first: int) -> None:
    """As nabu keeps those of BLISS: a dataset for each place, named by the number of the frame."""
    with h5py.File(tmp_path / "flats.h5", "w") as file:
        for n, (place, counts) in enumerate(((0, 900), (45, 800), (90, 700))):
            file[f"entry0000/flats/{first + place}"] = np.full(SHAPE, counts, np.float32)
            file[f"entry0000/darks/{n}"] = np.full(SHAPE, n, np.float32)
    views = np.arange(10, dtype=np.float32)[:, None, None] * np.ones(SHAPE, np.float32)
    options = SourceOptions(tmp_path / "v.npy", darks=tmp_path / "flats.h5", flats=tmp_path / "flats.h5")
    np.save(tmp_path / "v.npy", views)
    with open_scan(options) as source:
        assert source.table.kinds.tolist() == [2, 2, 2, 1, *[0] * 5, 1, *[0] * 5, 1]
        assert source.read(source.table.flats)[:, 0, 0].tolist() == [900, 800, 700]
        assert source.read([-1, 0, 4])[:, 1, 1].tolist() == [700, 0, 0]
        np.testing.assert_array_equal(source.read(source.table.views, slice(1, 3)), views[:, 1:3])


@pytest.mark.parametrize(("last", "expected"), [(45, 3 + 45), (90, 3 + 90), (89, 3 + 90)])
def test_flats_of_three_frames_stand_before_the_frame_of_their_number(tmp_path: Path, last: int, expected: int) -> None:
    with h5py.File(tmp_path / "flats.h5", "w") as file:
        for place in (0, last):
            file[f"entry0000/flats/{place}"] = np.full((3, *SHAPE), 900 + place, np.float32)
    np.save(tmp_path / "v.npy", np.zeros((90, *SHAPE), np.float32))
    with open_scan(SourceOptions(tmp_path / "v.npy", darks="0", flats=tmp_path / "flats.h5")) as source:
        assert source.table.flats.tolist() == [1, 2, 3, *range(1 + expected, 4 + expected)]
