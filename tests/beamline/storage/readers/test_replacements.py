"""Angles beside the frames are laid on only where the counts fit; darks and flats are the same in any file."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.errors import DataError
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.replacements import (
    assign,
    evenly_spaced_window,
    load_angles,
    load_images,
    parse_angles,
    select_rows,
)
from beamline.storage.readers.stacks import StacksSource
from drivers.base.frame import FrameKind

KEY = [2, 1, 0, 0, 0, 1, -1]


def test_text_is_degrees_and_arrays_are_radians(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("# degrees\n0\n90.0\n-180\n")
    np.testing.assert_allclose(load_angles(tmp_path / "a.txt"), [0, np.pi / 2, -np.pi])
    np.testing.assert_array_equal(load_angles([0.0, 1.5]), [0, 1.5])


@pytest.mark.parametrize("content", ["", "# nothing\n", "0 1\n2 3\n", "zero\n"])
def test_what_is_no_list_of_angles_is_refused(content: str) -> None:
    with pytest.raises(DataError, match="degrees a line"):
        parse_angles(content, "a.txt")


def test_a_log_may_hold_no_angle_for_darks_and_flats_but_no_other_word() -> None:
    np.testing.assert_array_equal(parse_angles("nan\nNaN\n0\n180\n", "a.txt"), [np.nan, np.nan, 0, np.pi])
    with pytest.raises(DataError, match=r"a\.txt: line 2 holds 'inf'"):
        parse_angles("0\ninf\n", "a.txt")


class Frames(StacksSource):
    """Frames without pixels, with image keys and the numbers of their files."""

    def __init__(self, key: list[int], *, in_order: bool = True, numbers: list[int] | None = None) -> None:
        self.path, self.in_order = Path("scan"), in_order
        self.table = FrameTable.of(key, numbers=None if numbers is None else np.array(numbers, np.int64))
        self.facts, self.shape = {"missing_numbers": "some"}, (1, 1)


def test_one_angle_a_projection_or_one_a_frame() -> None:
    frames = Frames(KEY)
    np.testing.assert_array_equal(assign(frames, np.array([1.0, 2, 3]), "a"), [np.nan, np.nan, 1, 2, 3, np.nan, np.nan])
    np.testing.assert_array_equal(assign(frames, np.arange(7.0), "a"), np.arange(7.0))
    with pytest.raises(DataError, match=r"has 4 angles"):
        assign(frames, np.arange(4.0), "a")


REFERENCES = [2, 2, 1, 1]


@given(
    before=st.integers(0, 4),
    views=st.integers(8, 40),
    stands=st.sampled_from([0.0, 178.0, 90.0]),
)
def test_a_log_of_all_frames_is_refused_where_their_order_is_unknown(before: int, views: int, stands: float) -> None:
    """Whatever the order was, nothing turns a view by the references before it. The rows that are advised are right."""
    scan = np.radians(np.linspace(0, 178, views))
    log = np.concatenate((np.full(before, stands), scan, np.full(4 - before, stands)))
    frames = Frames(REFERENCES + [0] * views, in_order=False)
    with pytest.raises(DataError, match="flats were taken") as refused:
        assign(frames, log, "log.txt")
    advised = re.search(r"--angle-rows (\d+:\d+) takes", str(refused.value))
    assert advised is None or advised[1] == f"{before}:{before + views}"
    rows = log[before : before + views]
    np.testing.assert_array_equal(assign(frames, rows, "log.txt", of_views=True)[4:], scan)
    assert np.isnan(assign(frames, rows, "log.txt")[:4]).all()


def test_nan_or_numbers_of_files_tell_the_order_of_all_frames() -> None:
    scan = np.linspace(0, 3, 10)
    log = np.concatenate(([np.nan] * 2, scan[:5], [np.nan] * 2, scan[5:]))
    frames = Frames(REFERENCES + [0] * 10, in_order=False)
    np.testing.assert_array_equal(assign(frames, log, "a")[4:], scan)
    numbered = Frames(REFERENCES + [0] * 10, in_order=False, numbers=[12, 13, 0, 1, *range(2, 12)])
    log = np.concatenate(([9.0] * 2, scan, [8.0] * 2))
    np.testing.assert_array_equal(assign(numbered, log, "a"), [8, 8, 9, 9, *scan])


@given(st.data())
def test_lost_images_never_move_the_angles_of_others(data: st.DataObject) -> None:
    """The log has a row for each trigger; the files say by their numbers which images are there."""
    triggers, first = data.draw(st.integers(10, 60)), data.draw(st.integers(0, 3))
    lost = data.draw(st.sets(st.integers(0, triggers - 1), min_size=1, max_size=5))
    kept = [row for row in range(triggers) if row not in lost]
    references = data.draw(st.sampled_from([[], REFERENCES]))
    log = np.radians(data.draw(st.floats(-90, 90)) + np.arange(triggers) * 180 / triggers)
    numbers = [0, 1, 0, 1][: len(references)] + [first + row for row in kept]
    frames = Frames(references + [0] * len(kept), in_order=not references, numbers=numbers)
    n = len(references)
    try:
        assigned = assign(frames, log, "log.txt")[n:]
    except DataError as error:
        assert {0, triggers - 1} & lost, "only the ends are not known by the numbers"
        assert " takes the " not in str(error)
    else:
        np.testing.assert_array_equal(assigned, log[kept])
    np.testing.assert_array_equal(assign(frames, log[kept], "log.txt")[n:], log[kept])


def test_the_gap_is_named_where_the_angles_fit_nothing() -> None:
    frames = Frames([0] * 9, numbers=[0, 1, 2, 3, 5, 6, 7, 8, 9])
    with pytest.raises(DataError, match=r"from 0 to 9"):
        assign(frames, np.linspace(0, 3, 8), "a")


@pytest.mark.parametrize(
    ("rows", "expected"), [("2:5", [2, 3, 4]), (":2", [0, 1]), ("7:", [7, 8, 9]), (":", list(range(10)))]
)
def test_rows_are_pythons(rows: str, expected: list[int]) -> None:
    assert select_rows(np.arange(10.0), rows).tolist() == expected


@pytest.mark.parametrize("rows", ["", "3", "5:2", "2:11", "a:b", "-3:5", "1:5:2", "4:4"])
def test_rows_that_do_not_lie_in_the_table_are_refused(rows: str) -> None:
    with pytest.raises(DataError, match=r"^--angle-rows "):
        select_rows(np.arange(10.0), rows)


@given(
    before=st.integers(0, 12),
    after=st.integers(0, 12),
    n=st.integers(4, 40),
    step=st.floats(0.01, 5) | st.floats(-5, -0.01),
    start=st.floats(-200, 200),
)
def test_the_scan_is_found_between_standing_references(
    before: int, after: int, n: int, step: float, start: float
) -> None:
    scan = np.radians(start + step * np.arange(n))
    table = np.concatenate([np.full(before, scan[0]), scan, np.full(after, scan[-1])])
    expected = (before, before + n - 1) if before + after else None
    assert evenly_spaced_window(table, n) == expected


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
    with pytest.raises(DataError, match=r"several datasets.*/a/dark \(4 x 6 x 8\).*--darks FILE::DATASET"):
        load_images(path, FrameKind.DARK, SHAPE)
    with pytest.raises(DataError, match=r"no dataset /b\. It has"):
        load_images(f"{path}::/b", FrameKind.DARK)
    with pytest.raises(DataError, match=r"of 9 x 9"):
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
    with pytest.raises(DataError, match=r"gone\.h5"):
        load_images(tmp_path / "v.h5", FrameKind.DARK)


def test_a_number_stands_for_darks_of_every_pixel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    darks = load_images("300", FrameKind.DARK, (2, 3))
    assert (darks.tolist(), darks.dtype) == ([[[300] * 3] * 2], np.uint16)
    tifffile.imwrite("300", np.full((2, 3), 7, np.uint16))
    assert load_images("300", FrameKind.DARK, (2, 3)).max() == 7
    with pytest.raises(DataError, match="cannot be read"):
        load_images("301.5", FrameKind.DARK, (2, 3))
