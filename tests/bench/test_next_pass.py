"""The bench of the next pass judges as it says, on made-up scores, and its scenes are those that were frozen.

Run with  pytest -m bench tests/bench/test_next_pass.py  (a minute).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.bench.next_pass import Score, ScoreFile, State, fixed, hindsight, judged, views_of
from tests.bench.next_pass_scenes import CRUMBED, PASS, PASSES, RECIPES, VIEWS, scene_of

pytestmark = pytest.mark.bench
FROZEN = {0: (0.6176541, 0.004823597), 2: (0.78914, 0.004135457), 5: (1.523901, 0.01190621)}
"""Mean line integral and mean density of scenes."""
FITS, WIDE, CRUMB = 0, 2, 4


def kept_of(path: Path, number: int, quality: dict[State, float]) -> ScoreFile:
    scores = ScoreFile(path)
    scores.scores = {f"{number}|0|r2|{state}": Score(db, 1.0, 1.0) for state, db in quality.items()}
    return scores


@pytest.mark.parametrize("number", FROZEN)
def test_scenes_are_those_that_were_frozen(number: int) -> None:
    scene = scene_of(number)
    assert (scene.clean.mean(), scene.truth.mean()) == pytest.approx(FROZEN[number], rel=1e-5)


@pytest.mark.parametrize("reached", range(1, PASSES + 1))
def test_hindsight_is_the_first_state_within_a_decibel(tmp_path: Path, reached: int) -> None:
    curve = {State(n): 30.0 - 2.0 * (n < reached) + 0.01 * n for n in range(1, PASSES + 1)}
    assert hindsight(FITS, kept_of(tmp_path / "scores", FITS, curve)) == State(reached)


def test_wide_views_count_where_they_were_needed(tmp_path: Path) -> None:
    plain = {State(n): 20.0 + 0.1 * n for n in range(1, PASSES + 1)}
    wide = {State(n, wide=True): 25.0 + n for n in range(1, PASSES + 1)}
    best = hindsight(WIDE, kept_of(tmp_path / "scores", WIDE, plain | wide))
    assert best == State(7, wide=True)
    assert best.frames(WIDE) == 7 * PASS + 8


def test_the_fixed_plan_lies_between_whole_passes(tmp_path: Path) -> None:
    scores = kept_of(tmp_path / "scores", FITS, {State(n): 20.0 + n * n for n in range(1, PASSES + 1)})
    assert [fixed(FITS, scores, frames) for frames in (PASS, PASS * 3 // 2, 2 * PASS, VIEWS)] == [21, 22.5, 24, 84]


def test_spoilt_views_are_left_out_until_they_are_taken_again() -> None:
    spoilt, _ = views_of(CRUMB, 0, State(4))
    whole, geometry = views_of(CRUMB, 0, State(4, retaken=True))
    assert len(spoilt) == len(whole) - len(CRUMBED) == 4 * PASS - len(CRUMBED)
    assert np.unique(geometry.angles).size == 4 * PASS


def test_a_pass_taken_again_has_other_noise_at_the_same_angles() -> None:
    views, geometry = views_of(FITS, 0, State(2, (1,)))
    np.testing.assert_array_equal(geometry.angles[2 * PASS :], geometry.angles[PASS : 2 * PASS])
    noise = np.std(views[2 * PASS :] - views[PASS : 2 * PASS]) / np.sqrt(2)
    expected = np.sqrt(np.mean(np.exp(views)) / RECIPES[FITS].photons)
    assert noise == pytest.approx(expected, rel=0.05)


def test_quality_is_that_of_the_field() -> None:
    truth = np.ones((2, 40, 40), np.float32)
    x = np.arange(40) - 19.5
    outside = np.hypot(x[:, None], x) > 19.5
    volume = np.where(outside, 9.0, 1.1).astype(np.float32) * truth
    assert judged(volume, truth) == pytest.approx((20.0, 1.1), rel=1e-5)
