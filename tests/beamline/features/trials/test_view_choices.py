"""Which projections the rows of a study use, and how projections are averaged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.features.trials.run_trial import averaged
from beamline.features.trials.view_choices import STUDIES, ViewChoice, ViewSet
from recon.base.geometry import Geometry
from recon.base.view_data import Views

HALF_TURN = np.radians(np.arange(1800) * 0.1)


def rows(name: str, angles: np.ndarray = HALF_TURN, draws: int = 3) -> dict[str, ViewChoice]:
    return {row.label: row for row in chosen(name, ViewSet(angles, np.pi, draws=draws))}


def chosen(name: str, views: ViewSet) -> Sequence[ViewChoice]:
    return STUDIES[name].rows(views)


def degrees(row: ViewChoice, angles: np.ndarray = HALF_TURN) -> np.ndarray:
    assert row.groups is not None
    return np.degrees(angles[np.array(row.groups)[:, 0]])


def test_fewer_views_are_evenly_spread_over_half_a_turn() -> None:
    found = rows("fixed-views")
    assert [(row.n_views, row.window) for row in found.values()] == [(360, 1), (180, 1), (90, 1), (45, 1)]
    for row in found.values():
        np.testing.assert_allclose(degrees(row), np.arange(row.n_views) * 180 / row.n_views, atol=1e-9)


def test_sectors_have_the_counts_of_the_published_tables() -> None:
    found = rows("sector")
    counts = {label: row.n_views for label, row in found.items()}
    assert counts == {
        "fixed, 120 views": 120, "fixed, 60 views": 60,
        "sector 30-150°, 120 views": 120, "sector 45-135°, 90 views": 90, "sector 60-120°, 60 views": 60,
        "sector 45-135°, 120 views": 120, "sector 60-120°, 120 views": 120,
        "sector 30-150°, 60 views": 60, "sector 45-135°, 60 views": 60,
    }  # fmt: skip
    narrow = degrees(found["sector 60-120°, 120 views"])
    assert narrow.min() == pytest.approx(60) and 119 < narrow.max() <= 120 + 1e-9
    assert np.diff(narrow).max() <= 0.6 + 1e-9


def test_random_views_are_other_ones_each_draw_and_the_same_ones_again() -> None:
    one, again = rows("random"), rows("random")
    assert [row.n_views for row in one.values()] == [360] * 4 + [180] * 4 + [90] * 4 + [45] * 4
    draws = [row.groups for row in one.values() if row.family == "random, 45 views"]
    assert len({tuple(np.ravel(draw)) for draw in draws if draw is not None}) == 3
    for label, row in one.items():
        np.testing.assert_array_equal(row.groups, again[label].groups)


def test_windows_are_those_of_the_published_tables() -> None:
    found = [row for row in rows("window-average").values() if row.window > 1]
    disjoint, overlapping = found[:3], found[3:]
    assert [(row.n_views, row.window) for row in disjoint] == [(180, 10), (90, 20), (60, 30)]
    assert [(row.n_views, row.window) for row in overlapping] == [(180, w) for w in (20, 30, 40, 50, 60)]
    for row in disjoint:
        assert np.array_equal(np.sort(row.groups, axis=None), np.arange(1800))  # type: ignore[arg-type]
    for row in found:
        assert row.groups is not None and (np.diff(row.groups, axis=1) == 1).all()
        assert (row.groups[0][0], row.groups[-1][-1]) == (0, 1799)


def test_no_window_spans_a_gap_or_half_a_turn() -> None:
    angles = np.radians(np.r_[np.arange(0, 80, 0.5), np.arange(100, 180, 0.5)])
    widest = [
        np.ptp(np.degrees(angles[np.array(row.groups)]), axis=1).max()
        for row in chosen("window-average", ViewSet(angles, np.pi))
        if row.groups is not None
    ]
    assert max(widest) < 12


@pytest.mark.parametrize("name", STUDIES)
def test_rows_that_ask_for_too_much_are_left_out_with_the_reason(name: str) -> None:
    few = np.radians(np.arange(0, 180, 2.0))
    for row in chosen(name, ViewSet(few, np.pi)):
        assert (row.groups is None) == bool(row.reason)
        assert row.groups is None or row.n_views <= few.size
    assert any(row.reason for row in chosen(name, ViewSet(few, np.pi)))


@given(st.integers(1, 5), st.floats(0.0, 200.0))
def test_a_mean_of_views_is_that_of_their_light(window: int, offset: float) -> None:
    rng = np.random.default_rng(window)
    views = (rng.random((7, 2, 3)) * 3 + offset).astype(np.float32)
    angles = np.sort(rng.random(7))
    groups = np.arange(3)[:, None] + np.arange(window)
    mean = averaged(Views(views, Geometry.parallel(angles, (2, 3))), ViewChoice("", groups.tolist()))
    light = np.exp(-views.astype(np.longdouble))
    expected = [-np.log(sum(light[g] for g in group) / window) for group in groups]
    np.testing.assert_allclose(mean.data, np.array(expected, np.float64), rtol=3e-6, atol=1e-5)
    np.testing.assert_allclose(mean.geometry.angles, [angles[group].mean() for group in groups])


def test_a_frame_that_several_views_share_is_dose_once() -> None:
    row = ViewChoice("overlapping", [[0, 1, 2], [1, 2, 3], [2, 3, 4]])
    assert (row.n_views, row.window, row.frames) == (3, 3, 5)
    assert ViewChoice("left out", None, reason="too few").frames == 0
