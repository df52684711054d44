"""What the league measures with: exact strip integrals, its judge, and the table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from tests.bench.league import SLICES, Score, judged, play, table
from tests.bench.quality_cases import Case, rows_of, strip_integrals

SIDE = 33
ANGLES = np.linspace(0, np.pi, 12, endpoint=False)


@pytest.fixture(scope="module")
def case() -> Case:
    rng = np.random.default_rng(0)
    truth = np.zeros((6, SIDE, SIDE), np.float32)
    truth[:, 9:22, 8:25] = rng.random((6, 13, 17))
    geometry = Geometry.parallel(ANGLES, (6, SIDE), pixel_pitch=0.5)
    return Case("box", strip_integrals(truth, geometry), geometry, Grid(truth.shape, 0.5), truth, 1.0)


def test_strips_hold_what_points_spread_over_a_voxel_throw_into_each_pixel() -> None:
    volume = np.zeros((1, SIDE, SIDE), np.float32)
    volume[0, 20, 11] = 2.0
    views = strip_integrals(volume, Geometry.parallel(ANGLES, (1, SIDE), pixel_pitch=0.5, axis_col=15.3))[:, 0]
    y, x = (np.indices((200, 200)) + 0.5) / 200 - 0.5
    for view, angle in zip(views, ANGLES, strict=True):
        place = 15.3 + (11 - 16 + x) * np.cos(angle) + (20 - 16 + y) * np.sin(angle)
        counts = np.bincount(np.rint(place).astype(int).ravel(), minlength=SIDE)
        np.testing.assert_allclose(view, 2.0 * 0.5 * counts / counts.sum(), atol=0.01)


def test_a_square_seen_along_its_edge_fills_its_own_pixels() -> None:
    volume: NDArray[np.float32] = np.zeros((1, SIDE, SIDE), np.float32)
    volume[0, 10:14, 5:9] = 1.0
    views = strip_integrals(volume, Geometry.parallel([0, np.pi / 2], (1, SIDE)))[:, 0]
    expected = np.zeros((2, SIDE))
    expected[0, 5:9] = expected[1, 10:14] = 4.0
    np.testing.assert_allclose(views, expected, atol=1e-5)


def test_the_judge_takes_the_truth_for_the_best_whether_by_itself_or_by_views(case: Case) -> None:
    per_pixel = case.truth * np.float32(0.5)
    unseen = case.projections[1::2], case.geometry.select(slice(1, None, 2)), np.ones((6, 6, SIDE), np.bool_)
    for each in (case, replace(case, unseen=unseen)):
        ten_percent, a_thousandth = judged(each, 0.9 * per_pixel), judged(each, 0.999 * per_pixel)
        assert a_thousandth == pytest.approx(ten_percent + 40, abs=0.01)


@pytest.mark.parametrize("name", ["splatline fbp", "scikit-image"])
def test_a_competitor_sees_the_sample_as_it_lies(case: Case, name: str) -> None:
    scores = play(name, case)
    shown = rows_of(case, range(SLICES))
    assert max(score.quality for score in scores) > 3 + judged(shown, np.zeros_like(shown.truth))


def test_the_table_has_the_default_and_the_best_setting_and_a_gap_where_nobody_plays() -> None:
    scores = {
        "bone": {"svmbir": [Score("default", 26.9, 7.0, 180.0), Score("sharpness 1", 30.2, 8.0, 185.0)]},
        "cone": {},
    }
    assert table(scores).splitlines()[2:] == [
        "| svmbir, default | 26.90, 7 s |  | 185 |",
        "| svmbir, best | 30.20, 8 s (sharpness 1) |  | |",
    ]
