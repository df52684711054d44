"""Angles beside the frames: laid on only where the counts fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.errors import DataError
from beamline.storage.readers.angle_table import assign, evenly_spaced_window, load_angles, parse_angles, select_rows

KEY = np.array([2, 1, 0, 0, 0, 1, -1], np.int32)


def test_text_is_degrees_and_arrays_are_radians(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("# degrees\n0\n90.0\n-180\n")
    np.testing.assert_allclose(load_angles(tmp_path / "a.txt"), [0, np.pi / 2, -np.pi])
    np.testing.assert_array_equal(load_angles([0.0, 1.5]), [0, 1.5])


@pytest.mark.parametrize("content", ["", "# nothing\n", "0 1\n2 3\n", "zero\n"])
def test_what_is_no_list_of_angles_is_refused(content: str) -> None:
    with pytest.raises(DataError, match="one angle in degrees a line"):
        parse_angles(content, "a.txt")


def test_a_log_may_hold_no_angle_for_darks_and_flats_but_no_other_word() -> None:
    np.testing.assert_array_equal(parse_angles("nan\nNaN\n0\n180\n", "a.txt"), [np.nan, np.nan, 0, np.pi])
    with pytest.raises(DataError, match=r"a\.txt: line 2 holds 'inf'"):
        parse_angles("0\ninf\n", "a.txt")


def test_a_missing_angle_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere\.txt cannot be read \(No such file or directory\)\.$"):
        load_angles(tmp_path / "nowhere.txt")


def test_one_angle_a_projection_or_one_a_frame() -> None:
    np.testing.assert_array_equal(assign(KEY, np.array([1.0, 2, 3]), "a"), [np.nan, np.nan, 1, 2, 3, np.nan, np.nan])
    np.testing.assert_array_equal(assign(KEY, np.arange(7.0), "a"), np.arange(7.0))
    with pytest.raises(DataError, match=r"a has 4 angles, but there are 3 projections among 7 frames"):
        assign(KEY, np.arange(4.0), "a")


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
