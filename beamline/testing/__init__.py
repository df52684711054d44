"""ReaderConformance: tests that every reader of scans must pass, as a pytest class from which the tests of a format
derive.

class TestMine(ReaderConformance):
    @pytest.fixture
    def path(self, tmp_path: Path) -> Path: ...      # a scan of at least four frames
    @pytest.fixture
    def frames(self) -> NDArray[Any]: ...            # its pixels [frame, row, col]
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.storage.readers.base import Quantity, ScanSource
from beamline.storage.readers.open import SourceOptions, open_scan
from drivers.base.frame import FrameKind


class ReaderConformance:
    """Tests that a `beamline.storage.readers.base.ScanSource` must pass, for a finished scan that is recognised by its
    path.
    """

    @pytest.fixture
    def path(self, tmp_path: Path) -> Path:
        pytest.fail("A subclass gives the fixture `path`: a scan of at least four frames in the reader's format.")

    @pytest.fixture
    def frames(self) -> NDArray[Any]:
        pytest.fail("A subclass gives the fixture `frames`: the pixels [frame, row, col] of the scan in `path`.")

    @pytest.fixture
    def source(self, path: Path, frames: NDArray[Any]) -> Iterator[ScanSource]:
        assert len(frames) >= 4
        with open_scan(path) as source:
            yield source

    def test_it_says_what_is_there(self, source: ScanSource, path: Path, frames: NDArray[Any]) -> None:
        n = len(frames)
        assert Path(source.path) == path and source.format
        assert (n, *source.shape) == frames.shape and source.dtype == frames.dtype
        assert source.quantity in get_args(Quantity)
        assert source.table.kinds.shape == source.table.angles.shape == source.table.exposures.shape == (n,)
        assert set(source.table.kinds.tolist()) <= set(FrameKind)
        assert source.finished and source.refresh() == n
        assert source.table.part_starts[0] == 0 and (np.diff(source.table.part_starts) > 0).all()

    def test_it_reads_any_frames_and_rows_in_the_order_asked_for(
        self, source: ScanSource, frames: NDArray[Any]
    ) -> None:
        last = len(frames) - 1
        np.testing.assert_array_equal(source.read(slice(None)), frames)
        np.testing.assert_array_equal(source.read([last, 0, 2]), frames[[last, 0, 2]])
        np.testing.assert_array_equal(source.read([-1]), frames[-1:])
        np.testing.assert_array_equal(source.read(np.array([1]), slice(1, 3)), frames[1:2, 1:3])
        assert source.read([]).shape == (0, *source.shape)

    def test_what_it_returns_may_be_changed(self, source: ScanSource, frames: NDArray[Any]) -> None:
        source.read([0])[:] = 0
        np.testing.assert_array_equal(source.read([0]), frames[:1])

    @pytest.mark.parametrize("beyond", [0, 1000])
    def test_frames_that_are_not_there_are_refused(self, source: ScanSource, frames: NDArray[Any], beyond: int) -> None:
        with pytest.raises(IndexError):
            source.read([len(frames) + beyond])

    def test_it_gives_frames_as_a_camera_does(self, source: ScanSource, frames: NDArray[Any]) -> None:
        found = list(source.frames(1))
        assert [frame.index for frame in found] == list(range(1, len(frames)))
        assert [int(frame.kind) for frame in found] == source.table.kinds[1:].tolist()
        np.testing.assert_array_equal([frame.angle for frame in found], source.table.angles[1:])
        np.testing.assert_array_equal(found[-1].counts, frames[-1])

    def test_a_second_reader_does_not_disturb_the_first(
        self, source: ScanSource, path: Path, frames: NDArray[Any]
    ) -> None:
        with open_scan(SourceOptions(path)) as other:
            np.testing.assert_array_equal(other.read([0]), source.read([0]))
        np.testing.assert_array_equal(source.read([1]), frames[1:2])

    def test_closing_twice_is_fine(self, path: Path) -> None:
        source = open_scan(path)
        source.close()
        source.close()
