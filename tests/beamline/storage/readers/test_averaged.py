"""Several frames per projection: the mean of the good ones, and which frames belong together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.monitor.checks import ALARM_SHIFT
from beamline.storage.flag_legend import TODAY, FrameFlags
from beamline.storage.readers.averaged import AveragedSource
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.transforms import cropped
from drivers.base.frame import FrameKind
from tests.beamline.array_source import ArraySource
from tests.beamline.scans import TwoCylinders, write_exchange

DARK, FLAT, VIEW, BACK = (
    int(kind) for kind in (FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION, FrameKind.ALIGNMENT)
)
INVALID = int(FrameKind.INVALID)


def scan(keys: list[int], degrees: Sequence[float], dtype: Any = np.uint16) -> Any:
    frames = np.random.default_rng(len(keys)).integers(0, 65_536, (len(keys), 3, 4)).astype(dtype)
    return ArraySource(frames, keys, np.radians(degrees))


def means(base: ArraySource, *groups: list[int] | NDArray[np.intp]) -> NDArray[np.float64]:
    return np.stack([base.read(group).astype(np.float64).mean(axis=0) for group in groups])


@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.uint32])
def test_a_view_is_the_mean_of_its_frames_and_references_stay(dtype: Any) -> None:
    base = scan([DARK, FLAT, FLAT, *[VIEW] * 6, FLAT], [0, 0, 0, 0, 0, 0, 5, 5, 5, 0], dtype)
    base.state(pass_ends=np.array([6, 9]))
    read = AveragedSource(base, 3)
    assert read.table.pass_ends.tolist() == [4, 5]
    np.testing.assert_array_equal(read.table.kinds, [DARK, FLAT, FLAT, VIEW, VIEW, FLAT])
    np.testing.assert_allclose(np.degrees(read.table.angles[3:5]), [0, 5])
    np.testing.assert_allclose(read.read([3, 4, 1]), means(base, [3, 4, 5], [6, 7, 8], [1]), rtol=6e-8)
    np.testing.assert_allclose(read.read([4], slice(1, 2)), means(base, [6, 7, 8])[:, 1:2], rtol=6e-8)
    assert read.dtype == np.float32 and read.frames_per_view == 3
    assert read.table.triggers.tolist() == [0, 1, 2, 3, 6, 9] and read.table.framestamps.tolist() == [7] * 6


def test_frames_that_are_missing_or_invalid_move_no_frame_to_another_view() -> None:
    base = scan([VIEW] * 4 + [INVALID] + [VIEW] * 4, [0, 0, 0, 4, 4, 4, 4, 8, 8])
    read = AveragedSource(base, 3)
    np.testing.assert_allclose(np.degrees(read.table.angles), [0, 4, 8])
    np.testing.assert_allclose(read.read(slice(None)), means(base, [0, 1, 2], [3, 5, 6], [7, 8]), rtol=6e-8)


def test_neighbours_of_a_fly_scan_may_be_averaged_and_flats_part_them() -> None:
    base = scan([*[VIEW] * 5, FLAT, *[VIEW] * 3, BACK], [0, 1, 2, 3, 4, 0, 5, 6, 7, 0])
    read = AveragedSource(base, 2)
    np.testing.assert_array_equal(read.table.kinds, [VIEW, VIEW, VIEW, FLAT, VIEW, VIEW, BACK])
    np.testing.assert_allclose(np.degrees(read.table.angles[read.table.kinds == VIEW]), [0.5, 2.5, 4, 5.5, 7])


@given(st.integers(2, 5), st.lists(st.integers(1, 5), min_size=3, max_size=9), st.floats(-7, 7))
def test_each_frame_is_in_one_view_of_its_angle(n: int, taken: list[int], step: float) -> None:
    """Of views of a step scan that lack frames, in any direction."""
    if abs(step) < 0.01 or max(taken) < 2:
        return
    frames = [min(each, n) for each in (*taken, n, n)]
    view_of = np.repeat(np.arange(len(frames)), frames)
    base = scan([VIEW] * view_of.size, (step * view_of).tolist())
    base.plan = {"angles_deg": np.repeat(step * np.arange(len(frames)), n).tolist()}
    read = AveragedSource(base, n)
    np.testing.assert_allclose(np.degrees(read.table.angles), step * np.arange(len(frames)), atol=1e-9)
    np.testing.assert_allclose(
        read.read(slice(None)), means(base, *(np.flatnonzero(view_of == i) for i in range(len(frames)))), rtol=6e-8
    )


def test_a_view_of_a_growing_scan_is_there_with_its_last_frame() -> None:
    degrees = [0, 0, 5, 5, 10, 10]
    whole = scan([VIEW] * 6, degrees)
    base = scan([VIEW] * 3, degrees[:3])
    base.finished, base.plan = False, {"angles_deg": degrees, "frames_per_view": 2}
    read = AveragedSource(base, 2)
    assert len(read.table) == 1 and read.plan["angles_deg"] == [0, 5, 10]
    base.table = whole.table
    assert read.refresh() == 3
    np.testing.assert_allclose(np.degrees(read.table.angles), [0, 5, 10])


def test_an_alarmed_frame_has_no_part_in_a_view_that_has_others() -> None:
    base, alarm, warning = scan([VIEW] * 6, [0, 0, 0, 5, 5, 5]), TODAY[0].bit, TODAY[1].bit
    bits = np.zeros(6, np.uint64)
    bits[[1, 3, 4, 5]] = 1 << alarm | 1 << alarm + ALARM_SHIFT
    bits[2] = 1 << warning
    scores, regions = np.full((6, len(TODAY)), np.nan, np.float32), np.full((6, len(TODAY), 4), -1, np.int32)
    scores[2, 1], scores[3:, 0] = -2, [1, -3, 2]
    regions[4, 0], regions[5, 0] = (0, 1, 2, 3), (1, 3, 1, 2)
    base.state(flags=FrameFlags(bits, TODAY, scores, regions))
    read = AveragedSource(base, 3)
    np.testing.assert_allclose(read.read([0, 1]), means(base, [0, 2], [3, 4, 5]), rtol=6e-8)
    flags = read.table.flags
    assert flags is not None and flags.scores is not None and flags.regions is not None
    assert flags.alarmed.tolist() == [False, True] and flags.flagged.tolist() == [True, True]
    assert flags.scores[:, :2].tolist()[0][1] == -2 and flags.scores[1, 0] == -3
    assert flags.regions[1, 0].tolist() == [0, 3, 1, 3] and (flags.regions[0] == -1).all()
    assert read.attributes["frames_left_out_by_alarms"] == 1


def test_damaged_frames_are_left_out_and_a_view_of_them_alone_is_damaged() -> None:
    base = scan([VIEW] * 4, [0, 0, 5, 5])
    base.damaged = frozenset({1, 2, 3})
    read = cropped(AveragedSource(base, 2), (0, 2))
    np.testing.assert_allclose(read.read([0]), means(base, [0])[..., :2], rtol=6e-8)
    assert read.damaged == {1} and read.frames_per_view == 2


def test_views_that_have_one_frame_each_are_refused(tmp_path: Path) -> None:
    sector = scan([VIEW] * 3, [0, 0, 5])
    assert AveragedSource(sector, 2).table.kinds.size == 2
    path = write_exchange(tmp_path / "s.h5", TwoCylinders(angles=np.radians([0, 0, 5, 5, 9, 9])))
    with open_scan(SourceOptions(path, frames_per_view=2, angles=np.radians([1, 2, 3]))) as source:
        np.testing.assert_allclose(np.degrees(source.table.angles[source.table.kinds == VIEW]), [1, 2, 3])
    with open_scan(SourceOptions(path, frames_per_view=None)) as source:  # it states none
        assert source.frames_per_view == 1 and source.dtype == np.uint16
    with pytest.raises(ConfigError, match="Omit --frames-per-view"):
        AveragedSource(scan([FLAT, VIEW], [0, 0]), 2)
