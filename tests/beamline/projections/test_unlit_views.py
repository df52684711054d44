"""Projections without beam are left out and named: at once, in batches and during a scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamline.core.errors import DataError
from beamline.projections.correction import apply, line_integrals_of, survey
from beamline.projections.corrections.air import Air
from beamline.projections.prepare import DiskBuffer
from beamline.projections.selection import Selection
from beamline.projections.views import select
from drivers.base.frame import FrameKind
from tests.beamline.array_source import ArraySource, counted
from tests.beamline.prepared_views import feed_batches, prepare
from tests.beamline.projections.replaced import ANGLES, AXIS, SHAPE, VIEWS, Blocks, line_integrals
from tests.beamline.scans import DARK, TwoCylinders

FIRST = 6  # row of the first view, behind three darks and three flats
SELECTION = Selection(axis_col=AXIS)


def scan(unlit: list[int], value: float | None, scale: float = 1.0) -> ArraySource:
    """A scan whose views `unlit` hold one value, or with None what a closed shutter leaves."""
    blocks = Blocks(1, 3, scale)
    views = blocks.of(FrameKind.PROJECTION)[0]
    views[unlit] = blocks.taken(np.zeros((len(unlit), *SHAPE)), 0.0) if value is None else value
    return blocks.source()


@pytest.mark.slow
@given(
    st.lists(st.integers(0, VIEWS - 1), min_size=1, max_size=VIEWS // 2, unique=True),
    st.sampled_from((None, 0.0, 65535.0, 100.0)),
)
@settings(deadline=None, max_examples=8)
def test_a_volume_is_that_of_the_other_views(unlit: list[int], value: float | None) -> None:
    found, told = prepare(scan(unlit, value), SELECTION)
    lit = np.setdiff1d(np.arange(VIEWS), unlit)
    np.testing.assert_array_equal(found.ids, FIRST + lit)
    np.testing.assert_allclose(found.geometry.angles, ANGLES[lit])
    assert sum("had no beam: the shutter was closed" in line for line in told) == 1
    np.testing.assert_allclose(found.seen.data, line_integrals()[lit], atol=0.12)


def test_more_than_half_of_the_views_are_refused() -> None:
    with pytest.raises(DataError, match="only 20 of 45"):
        prepare(scan(list(range(20, 45)), 0.0), SELECTION)


def test_in_slabs_and_while_a_scan_grows_they_are_the_same() -> None:
    unlit, frames = [3, 30, 31], FIRST + np.arange(VIEWS)
    source = scan(unlit, 0.0)
    at_once = line_integrals_of(select(source, SELECTION), frames)
    in_slabs, told = prepare(source, SELECTION, DiskBuffer(np.empty((VIEWS, *SHAPE), np.float32), 7))
    np.testing.assert_array_equal(in_slabs.seen.data, at_once.data)
    assert len([line for line in told if "3 projections of 45 (frames 9, 36-37) had no beam" in line]) == 1
    plan = survey(select(source, SELECTION).with_steps(Air("none")))
    fed, _ = feed_batches(plan, np.array_split(frames, 5), warn=told.append)
    np.testing.assert_array_equal(fed.view_ids, at_once.view_ids)


def test_line_integrals_that_were_never_written_are_left_out() -> None:
    lines = line_integrals() + np.random.default_rng(1).normal(0, 0.01, (VIEWS, *SHAPE))
    lines[[5, 40]] = 0
    source = ArraySource(lines.astype(np.float32), [0] * VIEWS, ANGLES)
    source.quantity = "line_integrals"
    found, told = prepare(source, SELECTION)
    assert found.geometry.n_views == VIEWS - 2 and "2 projections of 45 (frames 5, 40) had no beam" in told[0]


@pytest.mark.parametrize(
    ("cone", "ending"),
    [(None, "These projections are left out."), ((50.0, 100.0), "which leaves 32° without a projection.")],
)
def test_rays_of_the_other_half_of_a_turn_fill_a_gap_only_in_a_parallel_beam(
    cone: tuple[float, float] | None, ending: str
) -> None:
    round_sample = line_integrals()[0] + line_integrals()[0][:, ::-1]  # looks the same from all sides
    lines = round_sample + np.random.default_rng(1).normal(0, 0.01, (VIEWS, *SHAPE))
    lines[10:13] = 0
    source = ArraySource(lines.astype(np.float32), [0] * VIEWS, 2 * ANGLES)
    source.quantity = "line_integrals"
    told = prepare(source, replace(SELECTION, cone=cone, pixel_size_mm=0.01))[1]
    assert sum(line.endswith(ending) for line in told if "had no beam" in line) == 1


def test_a_band_in_which_the_sample_is_opaque_has_views_with_light() -> None:
    """A metal plate fills some rows of the field; above it there is air."""
    scene = TwoCylinders(shape=(8, 40))
    counts = scene.counts()
    counts[:, 4:] = DARK + 2
    selection = Selection(rows=(4, 8), axis_col=scene.axis_col, steps=(Air("none"),))
    source = counted(counts, scene.angles)
    plan = survey(select(source, selection))
    assert apply(plan, np.arange(2, 47), warn=pytest.fail).view_ids.size == 45
