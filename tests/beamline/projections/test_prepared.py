"""Held-out projections: evenly spread; none if the selection leaves some out; one set for the reconstruction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beamline.projections.prepared import PreparedProjections, hold_out
from beamline.projections.selection import Selection
from tests.beamline.array_source import counted
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import TwoCylinders

ANGLES = np.radians(np.arange(0, 180, 6.0))


def _prepared(views: str, angles: np.ndarray = ANGLES) -> PreparedProjections:
    scan = TwoCylinders(angles=angles, shape=(2, 40))
    return prepare(counted(scan.counts(), angles), Selection(views=views, axis_col=scan.axis_col))[0]


def _every_tenth(prepared: PreparedProjections) -> PreparedProjections:
    return hold_out(prepared, 10, advice="leave out --early-stop")


def test_every_tenth_view_is_held_out_where_all_were_chosen() -> None:
    everything = _prepared("all")
    kept = _every_tenth(everything)
    assert kept.lines.unseen is not None
    np.testing.assert_allclose(np.degrees(kept.lines.unseen.geometry.angles), [30, 90, 150])
    np.testing.assert_array_equal(kept.lines.unseen.data, everything.seen.data[[5, 15, 25]])
    rest = np.setdiff1d(np.arange(30), [5, 15, 25])
    np.testing.assert_array_equal(kept.seen.data, everything.seen.data[rest])
    np.testing.assert_array_equal(kept.ids, everything.ids[rest])
    np.testing.assert_array_equal(kept.geometry.angles, everything.geometry.angles[rest])
    assert kept.corrected.air.shape == (27,)


def test_a_selection_that_left_some_out_is_not_cut_further() -> None:
    prepared = _prepared("fixed:20")
    assert _every_tenth(prepared) is prepared


@pytest.mark.parametrize("n", [3, 9])
def test_few_views_still_leave_one(n: int) -> None:
    kept = _every_tenth(_prepared("all", np.linspace(0, 3, n)))
    assert kept.lines.unseen is not None
    assert (kept.geometry.n_views, kept.lines.unseen.geometry.n_views) == (n - 1, 1)


def test_no_more_than_the_most_are_held_out_and_neither_the_first_nor_the_last() -> None:
    held = hold_out(_prepared("all"), 2, most=4, advice="").lines.unseen
    assert held is not None
    np.testing.assert_allclose(np.degrees(held.geometry.angles), [18, 66, 108, 156])


def test_one_set_for_the_reconstructor() -> None:
    prepared = _prepared("fixed:20")
    views, apart = prepared.views, prepared.views.unseen
    assert apart is not None and apart.ids is not None and views.ids is not None
    np.testing.assert_array_equal(views.held_out, np.arange(20, 30))
    assert np.shares_memory(views.seen.data, views.data) and np.shares_memory(apart.data, views.data)
    np.testing.assert_array_equal(np.sort(views.ids), _prepared("all").views.ids)
    np.testing.assert_array_equal(views.seen.geometry.angles, prepared.geometry.angles)
    np.testing.assert_allclose(apart.geometry.angles, ANGLES[apart.ids - views.ids.min()])
    assert _prepared("all").views.unseen is None


def test_rows_that_no_ray_measured_are_told_by_these_views_and_beside_masked_areas() -> None:
    everything = _prepared("all")
    ids, measured = everything.ids, np.ones((2, 40), np.bool_)
    measured[:, 10:20] = False  # dead, so that runs end there
    runs = [[view, 0, *ends] for view in ids for ends in ((0, 10), (20, 40))]
    runs += [[view, 1, 0, 40] for view in ids[::2]]
    dark = replace(everything.corrected, unmeasured=np.array(runs, np.int64))
    everything = replace(everything, corrected=dark, sources=replace(everything.sources, measured=measured))
    even, odd = (everything.of_views(np.arange(first, ids.size, 2)) for first in (0, 1))
    for views, lost in (everything, [0]), (even, [0, 1]), (odd, [0]):
        assert [found.tolist() for found in views.unmeasured_rows] == [lost, []]
