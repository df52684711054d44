"""Cropped columns: the scan is that of a narrower detector."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.projections.corrections.resampling import TiltAndLens
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.storage.flag_legend import TODAY, FrameFlags
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.transforms import cropped
from beamline.storage.rules.flag_policy import flag_policy
from recon.prep.resample import Distortion
from tests.beamline.array_source import ArraySource
from tests.beamline.storage.readers.test_conformance import FRAMES, SCANS


@pytest.fixture(params=list(SCANS.values()), ids=list(SCANS))
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    name, write = request.param
    found: Path = write(tmp_path / name)
    return found


def test_pixels_are_those_of_the_columns(path: Path) -> None:
    with open_scan(SourceOptions(path, cols=(1, 4))) as source:
        assert source.shape == (4, 3) and source.cols == (1, 4)
        np.testing.assert_array_equal(source.read(slice(None)), FRAMES[..., 1:4])
        np.testing.assert_array_equal(source.read([2, 0], slice(1, 3)), FRAMES[[2, 0], 1:3, 1:4])
        np.testing.assert_array_equal([frame.counts for frame in source.frames(1)], FRAMES[1:, :, 1:4])


def test_everything_else_is_as_in_the_whole_scan(path: Path) -> None:
    with open_scan(path) as whole, open_scan(SourceOptions(path, cols=(1, 4))) as part:
        for name, column in vars(whole.table).items():
            np.testing.assert_array_equal(getattr(part.table, name), column)
        for name in ("quantity", "finished", "damaged", "plan", "attributes", "checksummed", "cone"):
            assert getattr(part, name) == getattr(whole, name)
        assert part.refresh() == whole.refresh()


class _Flagged(ArraySource):
    """A scan of 3 frames of 10 x 100 pixels. The second one has a flag in columns 60 to 70."""

    axis_col, row_period = 52.5, 2e-5

    def __init__(self) -> None:
        super().__init__(np.zeros((3, 10, 100), np.uint16), [0, 0, 0], np.zeros(3))
        regions = np.full((3, len(TODAY), 4), -1, np.int32)
        regions[1, 0] = 2, 6, 60, 70
        bits = np.array([0, 1 << TODAY[0].bit, 0], np.uint64)
        self.state(flags=FrameFlags(bits, TODAY, np.zeros((3, len(TODAY)), np.float32), regions))


@pytest.mark.parametrize(("cols", "left", "right"), [((40, 100), 19, 31), ((0, 65), 59, 65), ((0, 50), 59, 59)])
def test_regions_of_flags_move_with_the_columns(cols: tuple[int, int], left: int, right: int) -> None:
    from beamline.projections.usable_views import regions_of

    source: Any = cropped(_Flagged(), cols)
    assert source.axis_col == 52.5 - cols[0]
    treated = flag_policy(source.table.flags, np.ones(3, np.bool_), source.shape)
    (box,) = regions_of(treated).boxes
    assert box[2:].tolist() == [left, right] and treated.masked.tolist() == [False, True, False]


def test_the_lens_keeps_its_centre() -> None:
    lens = Distortion(48.0, 5.0, (1.0, 0.0, 1e-4))
    places = []
    for cols in ((0, 100), (30, 90)):
        source: Any = cropped(_Flagged(), cols)
        found = TiltAndLens(distortion=lens).of(select(source, Selection()))
        assert found is not None
        places.append(found.positions(source.shape, 0)[1] + cols[0])
    np.testing.assert_allclose(places[1], places[0][:, 30:90])


def _lines(path: Path, options: Selection, cols: tuple[int, int] | None = None) -> NDArray[np.float32]:
    from beamline.projections.prepare import prepare_projections

    with open_scan(SourceOptions(path, cols=cols)) as source:
        return prepare_projections(select(source, options), lambda said: None).seen.data


def test_line_integrals_are_those_of_a_narrower_detector(tmp_path: Path) -> None:
    from tests.beamline.storage.readers.test_dxchange import store

    rng, frames = np.random.default_rng(0), {}
    for name, level, n in (("data_dark", 10, 2), ("data_white", 3000, 3), ("data", 2000, 8)):
        frames[name] = rng.poisson(level, (n, 6, 40)).astype(np.uint16)
    theta = np.linspace(0, 157.5, 8)
    whole = store(tmp_path / "whole.h5", {**frames, "theta": theta})
    narrow = store(tmp_path / "narrow.h5", {**{k: v[..., 8:32] for k, v in frames.items()}, "theta": theta})
    asked = Selection(axis_col=11.0)
    np.testing.assert_array_equal(_lines(whole, asked, (8, 32)), _lines(narrow, asked))
