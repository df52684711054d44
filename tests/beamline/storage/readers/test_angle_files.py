"""Angles of a table, an array or an HDF5 file are those of a text with one a line, or the file says what to name; they
are given to frames only where their number fits."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.errors import DataError
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.angle_files import assign, evenly_spaced_window, load_angles, parse_angles, select_rows
from beamline.storage.readers.stacks import StacksSource
from tests.messages import refused

DEGREES = np.array([0.0, 2.5, 90.25, 179.5])
RADIANS = np.radians(DEGREES)


def table(head: str, row: str, *, comma: bool = False) -> str:
    rows = [row.format(i=i, deg=deg, rad=float(np.radians(deg))) for i, deg in enumerate(DEGREES)]
    return "\n".join([head, *(text.replace(".", ",") if comma else text for text in rows)]).lstrip("\n")


TABLES = {
    "comma": (table("frame,theta", "{i},{deg}"), ""),
    "semicolon": (table("frame;Angle [deg]", "{i};{deg}", comma=True), ""),
    "tab": (table("No\tRotation (rad)", "{i}\t{rad}"), ""),
    "blanks": (table("frame theta_deg time", "{i} {deg} 7"), ""),
    "comment": (table("# frame, angle", "{i}, {deg}"), ""),
    "quoted": (table('"No","angle"', '"{i}","{deg}"'), ""),
    "index": (table(",omega", "{i},{deg}"), ""),
    "one": (table("theta", "{deg}"), ""),
    "named": (table("theta_set,theta_read", "{i},{deg}"), "::theta_read"),
    "number": (table("", "{i},{deg}"), "::1"),
    "plain": (table("# angles in radians or not", "{deg}"), ""),
}


@pytest.mark.parametrize("name", TABLES)
def test_the_angles_of_a_table_are_in_the_column_that_is_named_so(tmp_path: Path, name: str) -> None:
    text, column = TABLES[name]
    (tmp_path / "a.csv").write_text(text)
    np.testing.assert_allclose(load_angles(f"{tmp_path / 'a.csv'}{column}"), RADIANS, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "column", "message"),
    [
        (table("theta_set,theta_read", "{i},{deg}"), "", "columns are theta_set, theta_read; .* FILE::COLUMN"),
        (table("frame,pos", "{i},{deg}"), "", "columns are frame, pos; .* FILE::COLUMN"),
        (table("frame,theta", "{i},{deg}"), "::omega", "columns are frame, theta"),
        (table("", "{i},{deg}"), "::2", "its 2 columns have no names"),
        (table("", "{i},{deg}"), "", "number of a projection and its angle.* FILE::COLUMN"),
        (table("frame,theta [turns]", "{i},{deg}"), "", "unit of the angles is 'turns'; give --angles-unit"),
        ("frame,theta\n0,0\n1,\n2,4", "", r"line 3 contains '\(empty\)'"),
        ("0 deg\n2 deg", "", "line 1 contains '0 deg'"),
        ("0.5°\n2.5°", "", "line 1 contains '0.5°'"),
    ],
)
def test_a_table_that_may_be_read_otherwise_is_refused(tmp_path: Path, text: str, column: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DataError, match=message):
        load_angles(f"{tmp_path / 'a.csv'}{column}")


def test_arrays_are_degrees_or_what_they_or_the_caller_say(tmp_path: Path) -> None:
    np.save(tmp_path / "deg.npy", DEGREES)
    np.save(tmp_path / "rad.npy", RADIANS[:, None])
    zarr.open_group(tmp_path / "z.zarr", mode="w").create_array("a/b", data=DEGREES)
    with h5py.File(tmp_path / "one.h5", "w") as file:
        file["theta"], file["count"] = RADIANS, np.arange(4.0)
        file["theta"].attrs["units"] = "rad"
    for name, unit in (("deg.npy", None), ("rad.npy", "rad"), ("z.zarr::a/b", None), ("one.h5", None)):
        np.testing.assert_allclose(load_angles(tmp_path / name, unit), RADIANS)
    np.testing.assert_allclose(load_angles(f"{tmp_path / 'one.h5'}::/count", "rad"), np.arange(4.0))
    with refused(DataError):
        load_angles(f"{tmp_path / 'one.h5'}::/count")
    with h5py.File(tmp_path / "one.h5", "r+") as file:
        file["count"].attrs["units"] = "deg"
    with refused(DataError):
        load_angles(tmp_path / "one.h5")


KEY = [2, 1, 0, 0, 0, 1, -1]


def test_text_is_degrees_and_arrays_are_radians(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("# degrees\n0\n90.0\n-180\n")
    np.testing.assert_allclose(load_angles(tmp_path / "a.txt"), [0, np.pi / 2, -np.pi])
    np.testing.assert_array_equal(load_angles([0.0, 1.5]), [0, 1.5])


@pytest.mark.parametrize("content", ["", "# nothing\n", "0 1\n2 3\n", "zero\n"])
def test_what_is_no_list_of_angles_is_refused(content: str) -> None:
    with pytest.raises(DataError, match="degrees per line"):
        parse_angles(content, "a.txt")


def test_a_log_may_hold_no_angle_for_darks_and_flats_but_no_other_word() -> None:
    np.testing.assert_array_equal(parse_angles("nan\nNaN\n0\n180\n", "a.txt"), [np.nan, np.nan, 0, np.pi])
    with pytest.raises(DataError, match=r"a\.txt: line 2 contains 'inf'"):
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
    with refused(DataError):
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
    with refused(DataError):
        assign(frames, np.linspace(0, 3, 8), "a")


@pytest.mark.parametrize(
    ("rows", "expected"), [("2:5", [2, 3, 4]), (":2", [0, 1]), ("7:", [7, 8, 9]), (":", list(range(10)))]
)
def test_rows_are_pythons(rows: str, expected: list[int]) -> None:
    assert select_rows(np.arange(10.0), rows).tolist() == expected


@pytest.mark.parametrize("rows", ["", "3", "5:2", "2:11", "a:b", "-3:5", "1:5:2", "4:4"])
def test_rows_that_do_not_lie_in_the_table_are_refused(rows: str) -> None:
    with refused(DataError):
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
