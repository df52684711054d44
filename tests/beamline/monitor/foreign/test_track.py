"""The statistic of a track: its false alarms follow from noise, and it finds a line that no single view shows."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.monitor.foreign.track import MEMORY, Octave, SampleMotion, Track, tracks_of, with_view

SHAPE, NOISE, LIGHT = (32, 128), 0.004, 0.4
SAMPLE = SampleMotion(np.radians(0.2), (63.5,), 70.0)


def played(views: int, depth: float, speed: float, least: float, octave: int = 1, seed: int = 5) -> list[Track]:
    """Tracks with a score above `least` in views of noise, with a blob that moves `speed` cells a view in row 16."""
    rng, state, found = np.random.default_rng(seed), Octave(octave), list[Track]()
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    weight = np.full(SHAPE, LIGHT, np.float32)
    for view in range(views):
        blob = depth * np.exp(-0.5 * (((rows - 16) ** 2 + (cols - speed * (view - 20)) ** 2) / 0.8**2))
        image = (1 + blob + rng.normal(0, NOISE / np.sqrt(LIGHT), SHAPE)).astype(np.float32)
        before = state.n
        state = with_view(state, view, float(view), image, weight)
        found += tracks_of(state, SAMPLE, least) if state.n > before else []
    return found


@pytest.mark.parametrize("octave", [1, 2])
def test_noise_has_no_track_above_the_limit(octave: int) -> None:
    assert played(300, 0.0, 3.0, 7.0, octave) == []


def test_the_highest_tracks_of_noise_are_those_of_a_gaussian() -> None:
    """In 300 views some 10^8 lines are tried: the largest of as many Gaussian numbers is 5.6."""
    scores = [track.score for track in played(300, 0.0, 3.0, 0.0)]
    assert 4.0 < max(scores) < 6.2


def test_a_crumb_far_below_the_peak_of_any_view_is_found_by_all_of_them() -> None:
    depth = 2.2 * NOISE / np.sqrt(LIGHT)  # in the smoothed cell about 3 standard deviations of a view
    tracks = played(70, depth, 2.6, 7.0)
    assert tracks and {track.row for track in tracks} <= {15, 16, 17}
    best = max(tracks, key=lambda track: track.score)
    assert best.speed == pytest.approx(2.6, abs=0.1) and best.rival < 0.6 * best.score and best.uneven < 2


@pytest.mark.parametrize("speed", [-4.0, 2.0, 6.0])
def test_the_score_grows_as_the_root_of_the_views(speed: float) -> None:
    rng = np.random.default_rng(1)
    weight, state, tracks = np.full(SHAPE, LIGHT, np.float32), Octave(1), list[Track]()
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    for view in range(45):
        at: NDArray[np.float64] = (cols - (64 + speed * (view - 22))) ** 2
        image = 1 + 0.02 * np.exp(-0.5 * ((rows - 16) ** 2 + at) / 0.8**2) + rng.normal(0, 0.006, SHAPE)
        state = with_view(state, view, float(view), image.astype(np.float32), weight)
        tracks += tracks_of(state, SAMPLE, 6.0)[:1]
    lengths = [len(track.steps) for track in tracks]
    assert max(lengths) <= MEMORY and max(lengths) > 1.5 * min(lengths)
    ratios = [track.score / np.sqrt(len(track.steps)) for track in tracks]
    assert np.std(ratios) < 0.25 * np.mean(ratios)


def test_a_point_of_the_sample_has_itself_as_rival() -> None:
    rng = np.random.default_rng(4)
    sample = SampleMotion(np.radians(2.0), (63.5,), 66.0)
    weight, state, tracks = np.full(SHAPE, LIGHT, np.float32), Octave(1), list[Track]()
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    for view in range(90):
        at = (cols - (63.5 + 60 * np.sin(np.radians(2.0) * (view - 45)))) ** 2
        image = 1 + 0.2 * np.exp(-0.5 * ((rows - 16) ** 2 + at) / 0.8**2) + rng.normal(0, 0.006, SHAPE)
        state = with_view(state, view, float(view), image.astype(np.float32), weight)
        tracks += tracks_of(state, sample, 7.0)
    assert tracks
    assert all(track.score**2 - track.rival**2 < 36 or track.rival > 0.85 * track.score for track in tracks)
