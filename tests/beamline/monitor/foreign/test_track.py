"""Track statistic: its false alarms follow from noise, and it finds a line that no single projection shows."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from beamline.monitor.foreign.track import MEMORY, Octave, SampleMotion, Track, tracks_of, with_view

SHAPE, NOISE, LIGHT = (32, 128), 0.004, 0.4
SAMPLE = SampleMotion(np.radians(0.2), (63.5,), 70.0)


def looks(
    views: int, depth: float, col: Callable[[int], float], least: float, octave: int = 1, sample: SampleMotion = SAMPLE
) -> Iterator[list[Track]]:
    """Tracks with a score above `least` after each of some views of noise, with a blob at a column of row 16."""
    rng, state = np.random.default_rng(5), Octave(octave)
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    weight = np.full(SHAPE, LIGHT, np.float32)
    for view in range(views):
        blob = depth * np.exp(-0.5 * (((rows - 16) ** 2 + (cols - col(view)) ** 2) / 0.8**2))
        image = (1 + blob + rng.normal(0, NOISE / np.sqrt(LIGHT), SHAPE)).astype(np.float32)
        before = state.n
        state = with_view(state, view, float(view), image, weight)
        yield tracks_of(state, sample, least) if state.n > before else []


def played(views: int, depth: float, speed: float, least: float, octave: int = 1) -> list[Track]:
    """All of them, of a blob that moves `speed` cells a view."""
    return [track for look in looks(views, depth, lambda view: speed * (view - 20), least, octave) for track in look]


@pytest.mark.parametrize("octave", [1, 2])
def test_noise_has_no_track_above_the_limit(octave: int) -> None:
    assert played(300, 0.0, 3.0, 7.0, octave) == []


def test_a_crumb_far_below_the_peak_of_any_view_is_found_by_all_of_them() -> None:
    depth = 2.2 * NOISE / np.sqrt(LIGHT)  # in the smoothed cell about 3 standard deviations of a view
    tracks = played(70, depth, 2.6, 7.0)
    assert tracks and {track.row for track in tracks} <= {15, 16, 17}
    best = max(tracks, key=lambda track: track.score)
    assert best.speed == pytest.approx(2.6, abs=0.1) and best.rival < 0.6 * best.score and best.uneven < 2


@pytest.mark.parametrize("speed", [-4.0, 2.0, 6.0])
def test_the_score_grows_as_the_root_of_the_views(speed: float) -> None:
    tracks = [look[0] for look in looks(45, 0.02, lambda view: 64 + speed * (view - 22), 6.0) if look]
    lengths = [len(track.steps) for track in tracks]
    assert max(lengths) <= MEMORY and max(lengths) > 1.5 * min(lengths)
    ratios = [track.score / np.sqrt(len(track.steps)) for track in tracks]
    assert np.std(ratios) < 0.25 * np.mean(ratios)
