"""Rays in the region of a flag get less weight; the rest of the projection is used unchanged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.projections.corrections.air import Air
from beamline.projections.prepared import hold_out
from beamline.projections.selection import Selection
from beamline.projections.usable_views import WARNED_SHARE, Regions, regions_of
from beamline.storage.flag_legend import FrameFlags
from beamline.storage.rules.flag_policy import flag_policy
from recon.prep.resample import Resampling
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged

NAME, OTHER = CHECKS[0].name, CHECKS[1].name
SHAPE = (20, 40)


def flag(view: int, region: tuple[int, int, int, int] | None, level: Level = Level.WARN, **more: object) -> Flag:
    return Flag(NAME, level, view, 1.0, 0.5, "", region, **more)  # type: ignore[arg-type]


def found(*flags: Flag, frames: int = 12) -> Regions:
    every = FrameFlags.of_flags([[f for f in flags if f.frame == row] for row in range(frames)])
    return regions_of(flag_policy(every, np.ones(frames, np.bool_), SHAPE))


def test_a_region_and_its_margin_weigh_less_of_an_alarm_nothing() -> None:
    regions = found(flag(3, (4, 8, 10, 18)), flag(5, (4, 8, 10, 18), Level.ALARM))
    assert sorted({*regions.frames.tolist()}) == [3, 5]
    weights = regions.weights(np.array([3, 4, 5]), slice(0, 20), 1, SHAPE)
    assert weights is not None
    expected = np.ones((3, *SHAPE), np.float32)
    expected[0, 3:9, 9:19], expected[2, 3:9, 9:19] = WARNED_SHARE, 0
    np.testing.assert_array_equal(weights, expected)


def test_rows_that_are_chosen_and_binned_pixels_take_their_part() -> None:
    regions = found(flag(3, (4, 8, 10, 18), Level.ALARM))
    weights = regions.weights(np.array([3]), slice(5, 13), 2, (4, 20))
    assert weights is not None
    np.testing.assert_allclose(weights[0, :2, 5:9], 0)
    np.testing.assert_allclose(weights[0, :2, 4], 0.5)
    np.testing.assert_allclose(weights[0, 2:], 1)
    assert regions.weights(np.array([1, 2]), slice(5, 13), 2, (4, 20)) is None


@pytest.mark.parametrize("binning", [1, 2])
def test_a_region_of_views_that_are_turned_lies_where_its_pixels_went(binning: int) -> None:
    resampling = Resampling(SHAPE, 0.2, binning=binning)
    plain = found(flag(3, (4, 12, 22, 32), Level.ALARM))
    shape = SHAPE[0] // binning, SHAPE[1] // binning
    straight = plain.weights(np.array([3]), slice(0, 20), binning, shape)
    turned = replace(plain, resampling=resampling).weights(np.array([3]), slice(0, 20), binning, shape)
    assert straight is not None and turned is not None
    there = straight.copy()
    resampling.apply(there, 0)
    assert not turned[there < 0.5].any()  # none of the region is missed, and nothing away from it is taken
    assert (turned[0][ndimage.minimum_filter(there[0], 3) > 0.5] == 1).all()
    some = replace(plain, resampling=resampling).weights(np.array([3]), slice(4, 12), binning, (8 // binning, shape[1]))
    assert some is not None
    np.testing.assert_array_equal(some, turned[:, 4 // binning : 12 // binning])


@pytest.mark.parametrize("region", [None, (0, 20, 0, 30)])
def test_without_a_region_or_with_most_of_the_view_the_whole_view_is_meant(
    region: tuple[int, int, int, int] | None,
) -> None:
    assert not found(flag(3, region)).frames.size
    regions = found(flag(3, (4, 8, 10, 18)), Flag(OTHER, Level.WARN, 3, 1.0, 0.5, "", region))
    assert regions.frames.size == 0


def test_a_view_with_a_region_is_used_beside_it(tmp_path: Path) -> None:
    data = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(4, 40))
    alarm, half = (flag(row, (0, 4, 10, 12), level) for row, level in ((8, Level.ALARM), (9, Level.WARN)))
    path = write_flagged(tmp_path / "scan.h5", frames_of(data), {}, flags=[alarm, half])
    prepared, told = prepare(path, Selection(axis_col=data.axis_col, steps=(Air("none"),)))
    assert prepared.geometry.n_views == 30 and prepared.origin.left_out == 0 and prepared.sources.view_weights is None
    rays = prepared.views.weights[...]
    assert rays.shape == (30, 4, 40)
    assert (rays[4, :, 10:12] == 0).all() and (rays[5, :, 10:12] == WARNED_SHARE).all()
    assert (rays != 1).any(axis=(1, 2)).sum() == 2
    assert "2 are flagged in a part of the image" in told[0]
    kept = hold_out(prepared, 10, advice="")
    assert kept.sources.region_weights is not None and len(kept.sources.region_weights) == kept.geometry.n_views
