"""Trail: peaks in consecutive views that lie on a straight line in time, faster than the sample could carry them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beamline.core.jit import njit

Peaks = NDArray[np.float64]
"""[peak, (view, row, col, score)] in cells; the score's sign is the peak's."""


def no_peaks() -> Peaks:
    return np.empty((0, 4))


class Rules(NamedTuple):
    """When peaks are a trail."""

    span: int  # views that it may take
    least: int  # views with a peak that it needs
    share: float  # of the views from its first to its last that have a peak
    total: float  # sum of the scores that it needs
    rows: float  # largest distance of a peak from the line, in cells
    cols: float  # likewise
    slack: float  # cells a view added to the sample's speed


class Trail(NamedTuple):
    """Views from `first` to `last`, the place in cells in the last one, and the mean score of its peaks."""

    first: float
    last: float
    row: float
    col: float
    speed: float  # cells a view
    score: float


def best_trail(older: Peaks, newer: Peaks, rules: Rules, middle: float, turn: float, radius: float) -> Trail | None:
    """The trail with the largest sum of scores that ends at one of the `newer` peaks, all of one view, if there is one.

    A point of the sample at col - middle = x moves by less than turn sqrt(radius² - x²) a view, `turn` in radians a
    view.
    """
    if not len(newer) or len(older) < rules.least - 1:
        return None
    found = np.zeros(6)
    return Trail(*found.tolist()) if _search(older, newer, rules, (middle, turn, radius), found) else None


@njit(nogil=True, cache=True)
def _search(older, newer, rules, sample, found):
    _, least, share, enough, rows, cols, slack = rules
    middle, turn, radius = sample
    best = enough
    seen = np.zeros(64)
    for i in range(newer.shape[0]):
        view, row, col, score = newer[i]
        for j in range(older.shape[0]):
            age = view - older[j, 0]
            if age < least - 1 or abs(older[j, 1] - row) > rows or older[j, 3] * score < 0:
                continue
            speed = (col - older[j, 2]) / age
            beside = 0.5 * (col + older[j, 2]) - middle
            if abs(speed) < turn * np.sqrt(max(radius * radius - beside * beside, 0.0)) + slack:
                continue
            seen[:] = 0.0
            seen[0] = abs(score)
            for k in range(older.shape[0]):
                back = view - older[k, 0]
                if back <= 0 or back > age or older[k, 3] * score < 0 or abs(older[k, 1] - row) > rows:
                    continue
                if abs(older[k, 2] - (col - speed * back)) <= cols:
                    seen[int(back)] = max(seen[int(back)], abs(older[k, 3]))
            n, total = 0, 0.0  # numba's count_nonzero compiles for a second
            for one in seen:
                n += int(one > 0)
                total += one
            if n >= least and n >= share * (age + 1) and total > best:
                best = total
                found[0], found[1], found[2], found[3] = older[j, 0], view, row, col
                found[4], found[5] = speed, np.sign(score) * total / n
    return best > enough
