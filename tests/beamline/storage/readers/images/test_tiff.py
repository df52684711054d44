"""TIFF scans: series by name and number, in folders and zip files; stacks page by page."""

from __future__ import annotations

import struct
import tracemalloc
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.features.files.validate import validate
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.reference_files import load_images
from drivers.base.frame import FrameKind
from tests.messages import refused

SHAPE = (6, 8)


@pytest.fixture
def series(tmp_path: Path, rng: np.random.Generator) -> tuple[Path, np.ndarray]:
    """12 projections whose names sort wrongly as text, 2 flats, 1 dark and an angle file; the projections."""
    images = rng.integers(0, 60000, (12, *SHAPE)).astype(np.uint16)
    folder = tmp_path / "scan"
    (folder / "tiffs").mkdir(parents=True)
    for i, image in enumerate(images):
        tifffile.imwrite(folder / "tiffs" / f"raw_{i}.tiff", image)
    for i in range(2):
        tifffile.imwrite(folder / f"flat_{i}.tif", np.full(SHAPE, 60000 + i, np.uint16))
    tifffile.imwrite(folder / "dark_0.tif", np.full(SHAPE, 7, np.uint16))
    np.savetxt(folder / "angles.txt", np.linspace(0, 165, 12))
    return folder, images


def zipped(folder: Path) -> Path:
    path = folder.with_suffix(".zip")
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*"), reverse=True):
            archive.write(file, file.relative_to(folder))
    return path


@pytest.mark.parametrize("packed", [False, True])
def test_a_folder_or_zip_explains_itself_by_names(series: tuple[Path, np.ndarray], packed: bool) -> None:
    folder, images = series
    with open_scan(zipped(folder) if packed else folder) as source:
        assert (source.format, source.quantity) == ("tiff_series", "counts")
        assert (source.shape, source.dtype) == (SHAPE, np.uint16)
        assert source.table.kinds.tolist() == [2, 1, 1, *[0] * 12]
        np.testing.assert_array_equal(source.read(np.arange(3, 15)), images)  # 9 before 10
        np.testing.assert_array_equal(source.read([14, 3], slice(2, 5)), images[[11, 0], 2:5])
        assert source.read([2])[0, 0, 0] == 60001
        np.testing.assert_allclose(source.table.angles[3:], np.radians(np.linspace(0, 165, 12)))
        assert np.isnan(source.table.angles[:3]).all()
        frame = list(source.frames())[13]
        assert (frame.kind, frame.index, frame.trigger) == (FrameKind.PROJECTION, 13, 10)


def test_angles_that_do_not_fit_are_refused_with_the_rows_that_would(series: tuple[Path, np.ndarray]) -> None:
    folder, _ = series
    table = [0.0] * 4 + list(np.linspace(0, 165, 12)) + [165.0] * 3
    np.savetxt(folder / "angles.txt", table)
    with refused(DataError):
        open_scan(folder)
    with open_scan(SourceOptions(folder, angle_rows="4:16")) as source:
        np.testing.assert_allclose(source.table.angles[3:], np.radians(np.linspace(0, 165, 12)))
    with open_scan(SourceOptions(folder, angles=folder / "angles.txt", angle_rows="4:16")) as source:
        np.testing.assert_allclose(source.table.angles[3:], np.radians(np.linspace(0, 165, 12)))


def test_explicit_angles_and_references_win(series: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    folder, images = series
    flats = np.full((3, *SHAPE), 50000, np.uint16)
    tifffile.imwrite(tmp_path / "dark_stack.tif", np.full((2, *SHAPE), 9, np.uint16), photometric="minisblack")
    angles = np.arange(12) * 0.1
    with open_scan(SourceOptions(folder, angles=angles, flats=flats, darks=tmp_path / "dark_stack.tif")) as source:
        assert source.table.kinds.tolist() == [2, 2, 1, 1, 1, 3, 3, 3, *[0] * 12]
        np.testing.assert_array_equal(source.table.angles[8:], angles)
        assert source.read([0, 4])[:, 0, 0].tolist() == [9, 50000]
        np.testing.assert_array_equal(source.read([8])[0], images[0])


def test_references_of_another_shape_and_several_series_are_refused(series: tuple[Path, np.ndarray]) -> None:
    folder, images = series
    with refused(DataError):
        open_scan(SourceOptions(folder, flats=np.zeros((2, 3, 3))))
    tifffile.imwrite(folder / "preview_1.tif", images[0])
    with refused(DataError):
        open_scan(folder)


def test_numbers_that_are_dates_are_no_counts(tmp_path: Path) -> None:
    for day in range(4):
        tifffile.imwrite(tmp_path / f"img_2026012{day}120000.tif", np.full(SHAPE, day, np.uint16))
    tracemalloc.start()
    with open_scan(tmp_path) as source:
        assert len(source.table) == 4
        assert "missing_numbers" not in source.attributes
    assert tracemalloc.get_traced_memory()[1] < 10e6  # every number between them took 8.6 GB for 24 files in a month
    tracemalloc.stop()


@pytest.mark.parametrize("later", [np.uint32, np.int16, np.float32])
def test_a_frame_of_a_larger_type_is_refused_not_wrapped(series: tuple[Path, np.ndarray], later: type) -> None:
    folder, _ = series
    tifffile.imwrite(folder / "tiffs" / "raw_7.tiff", np.full(SHAPE, 30000, later))
    with open_scan(folder) as source, pytest.raises(DataError, match=f"raw_7.tiff .*{later.__name__} pixels"):
        source.read(np.arange(3, 15))


def test_a_gap_in_the_numbers_is_told_and_moves_no_angle(series: tuple[Path, np.ndarray]) -> None:
    folder, images = series
    (folder / "tiffs" / "raw_5.tiff").unlink()
    there = np.delete(np.arange(12), 5)
    for rows in (None, "0:12"):
        with open_scan(SourceOptions(folder, angle_rows=rows)) as source:
            assert source.attributes["missing_numbers"] == "5"
            np.testing.assert_allclose(source.table.angles[3:], np.radians(np.linspace(0, 165, 12))[there])
            np.testing.assert_array_equal(source.read(np.arange(3, 14)), images[there])
    assert any(
        "these numbers are missing in the names of the files: 5." in finding.message for finding in validate(folder)
    )


def test_an_image_of_another_shape_or_a_broken_one_is_named(series: tuple[Path, np.ndarray]) -> None:
    folder, images = series
    tifffile.imwrite(folder / "tiffs" / "raw_5.tiff", images[0, :-1])
    (folder / "tiffs" / "raw_6.tiff").write_bytes(b"not a tiff")
    with open_scan(folder) as source:
        with refused(DataError):
            source.read([8])
        with refused(DataError):
            source.read([9])


def test_empty_and_broken_places_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with refused(DataError):
        open_scan(tmp_path / "empty")
    for name in ("broken.zip", "broken.tif"):
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with refused(DataError):
            open_scan(tmp_path / name)
    (tmp_path / "broken.h5").write_bytes(b"nothing of the kind")
    with pytest.raises(DataError, match="neither HDF5 nor TIFF"):
        open_scan(tmp_path / "broken.h5")


@pytest.mark.parametrize(
    "how",
    [
        {}, {"bigtiff": True}, {"bigtiff": True, "byteorder": ">"}, {"compression": "zlib"}, {"imagej": True},
        {"contiguous": False}, {"metadata": None, "bigtiff": True},
    ],
)  # fmt: skip
def test_a_stack_is_read_page_by_page(tmp_path: Path, rng: np.random.Generator, how: dict[str, object]) -> None:
    stack = rng.normal(size=(7, *SHAPE)).astype(np.float32)
    tifffile.imwrite(tmp_path / "s.tif", stack, photometric="minisblack", **how)
    with open_scan(SourceOptions(tmp_path / "s.tif", angles=np.arange(7.0))) as source:
        assert (source.format, source.quantity) == ("tiff_stack", "unknown")
        assert (source.shape, source.dtype) == (SHAPE, np.float32)
        np.testing.assert_array_equal(source.read(slice(None)), stack)
        np.testing.assert_array_equal(source.read([6, 0, 3], slice(1, 4)), stack[[6, 0, 3], 1:4])
        np.testing.assert_array_equal(source.read([2], slice(0, 6, 2)), stack[[2], 0:6:2])
        np.testing.assert_array_equal(source.table.angles, np.arange(7.0))


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_pages_appended_one_at_a_time_are_one_stack(
    tmp_path: Path, rng: np.random.Generator, compression: str | None
) -> None:
    stack = rng.normal(size=(7, *SHAPE)).astype(np.float32)
    for page in stack:
        tifffile.imwrite(tmp_path / "s.tif", page, append=True, compression=compression, bigtiff=True)
    with open_scan(tmp_path / "s.tif") as source:
        assert (source.shape, source.dtype, len(source.table)) == (SHAPE, np.float32, 7)
        np.testing.assert_array_equal(source.read(slice(None)), stack)
        np.testing.assert_array_equal(source.read([6, 3], slice(1, 4)), stack[[6, 3], 1:4])
    np.testing.assert_array_equal(load_images(tmp_path / "s.tif", FrameKind.FLAT), stack)


def test_pages_of_different_shapes_and_colours_are_refused(tmp_path: Path) -> None:
    for rows in (6, 6, 5):
        tifffile.imwrite(tmp_path / "s.tif", np.zeros((rows, 8), np.float32), append=True)
    tifffile.imwrite(tmp_path / "c.tif", np.zeros((3, *SHAPE, 3), np.uint8), photometric="rgb")
    for name in ("s.tif", "c.tif"):
        with refused(DataError):
            open_scan(tmp_path / name)


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("left", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("appended", [False, True])
def test_a_cut_stack_is_no_shorter_scan(
    tmp_path: Path, rng: np.random.Generator, compression: str | None, left: float, appended: bool
) -> None:
    stack = rng.normal(size=(7, 60, 80)).astype(np.float32)
    for part in stack if appended else [stack]:
        tifffile.imwrite(tmp_path / "s.tif", part, append=appended, photometric="minisblack", compression=compression)
    whole = (tmp_path / "s.tif").read_bytes()
    (tmp_path / "s.tif").write_bytes(whole[: int(len(whole) * left)])
    with pytest.raises(DataError, match="cannot be read"), open_scan(tmp_path / "s.tif") as source:
        source.read(slice(None))


def test_the_real_series_is_the_real_hdf5_scan(shared_data: Path) -> None:
    """The zip holds the same scan as the HDF5 file; rows 10:101 of angles.txt are its projections."""
    path = shared_data / "diamond_24737_tiff_series.zip"
    with pytest.raises(DataError, match=r"111 angles.*--angle-rows 10:101 "):
        open_scan(path)
    with (
        open_scan(SourceOptions(path, angle_rows="10:101")) as tiffs,
        open_scan(shared_data / "diamond_24737_parallel_91x135x160.h5") as exchange,
    ):
        np.testing.assert_allclose(tiffs.table.angles, exchange.table.angles, atol=1e-9)
        np.testing.assert_array_equal(tiffs.table.kinds, exchange.table.kinds)
        np.testing.assert_array_equal(tiffs.read(slice(None)), exchange.read(slice(None)))


def _packed(path: Path) -> None:
    """A TIFF of 12-bit pixels without gaps, as cameras' software writes them."""
    data = bytes(3 * SHAPE[0] * SHAPE[1] // 2)
    tags = [(256, 3, SHAPE[1]), (257, 3, SHAPE[0]), (258, 3, 12), (259, 3, 1), (262, 3, 1), (273, 4, 8), (277, 3, 1)]
    tags += [(278, 3, SHAPE[0]), (279, 4, len(data))]
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8 + len(data)) + data + struct.pack("<H", 9) + entries + bytes(4))


@pytest.mark.skipif(find_spec("imagecodecs") is not None, reason="it unpacks them")
def test_packed_pixels_are_refused_in_words(tmp_path: Path) -> None:
    for i in range(3):
        _packed(tmp_path / f"s/a_{i}.tif")
    for path in (tmp_path / "s", tmp_path / "s/a_0.tif"):
        with refused(DataError):
            open_scan(path)
    with pytest.raises(DataError, match=r"packed with 12 bits each"):
        load_images(tmp_path / "s", FrameKind.DARK)
