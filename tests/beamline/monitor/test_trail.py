"""Peaks on a line that is steeper than the sample's are a trail."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.monitor.trail import Rules, Trail, best_trail, no_peaks

RULES = Rules(span=12, least=4, share=0.4, total=20.0, rows=1.0, cols=1.0, slack=0.03)
SAMPLE = (63.5, 0.004, 64.0)  # middle, radians a view, radius: at most 0.256 cells a view


def line(speed: float, views: range, row: float = 5.0, score: float = 6.0) -> np.ndarray:
    return np.array([[view, row, 40 + speed * view, score] for view in views])


def found(peaks: np.ndarray, rules: Rules = RULES) -> Trail | None:
    last = peaks[:, 0].max()
    return best_trail(peaks[peaks[:, 0] < last], peaks[peaks[:, 0] == last], rules, *SAMPLE)


@pytest.mark.parametrize("speed", [0.4, -0.7, 5.0])
def test_a_trail_is_where_its_last_peak_is_and_as_fast(speed: float) -> None:
    trail = found(line(speed, range(6)))
    assert trail is not None
    assert (trail.first, trail.last, trail.row) == (0, 5, 5)
    assert trail.col == pytest.approx(40 + 5 * speed)
    assert (trail.speed, trail.score) == pytest.approx((speed, 6.0))


@pytest.mark.parametrize(
    "peaks",
    [
        line(0.2, range(8)),  # as slow as the sample
        line(0.9, range(3)),  # too few
        line(0.9, range(0, 12, 4)),  # too rarely
        line(0.9, range(6), score=3.0),  # too faint
        np.concatenate([line(0.9, range(3)), line(0.9, range(3, 6), row=8.0)]),  # in other rows
        np.concatenate([line(0.9, range(3)), line(0.9, range(3, 6), score=-6.0)]),  # of the other sign
    ],
)
def test_other_peaks_are_none(peaks: np.ndarray) -> None:
    assert found(peaks) is None


def test_near_the_samples_rim_the_limit_falls() -> None:
    slow = line(0.15, range(8))
    assert found(slow) is None
    slow[:, 2] += 82  # its points at the rim move along the beam
    assert found(slow) is not None


def test_clutter_around_it_does_not_hide_a_trail() -> None:
    rng = np.random.default_rng(2)
    clutter = np.column_stack(
        [rng.integers(0, 8, 60), rng.uniform(0, 32, 60), rng.uniform(0, 128, 60), np.full(60, 4.6)]
    )
    trail = found(np.concatenate([clutter, line(0.9, range(8))]))
    assert trail is not None
    assert trail.speed == pytest.approx(0.9, abs=0.1)


def test_nothing_is_no_trail() -> None:
    assert best_trail(no_peaks(), no_peaks(), RULES, *SAMPLE) is None
