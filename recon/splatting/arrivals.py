"""Arrivals: views that arrive one by one: their checks, the order of learning, and the effect of a moved axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.arrays import F32

_NEWEST = 0.2  # this share of the views counts as the newest
_ONE_IN = 16  # of so many views one is held out until the last round


def checked(data: ArrayLike, angles: NDArray[np.float64], detector_shape: tuple[int, int]) -> F32:
    """A copy of new line integrals [view, row, col] as float32.

    Raises:
        ValueError: shapes that disagree, or values or angles [view] that are not finite.
    """
    expected = (angles.size, *detector_shape)
    if angles.ndim != 1 or np.shape(data) != expected:
        raise ValueError(f"{angles.size} angles need projections of shape {expected}, got {np.shape(data)}")
    with np.errstate(over="ignore"):  # what float32 cannot hold counts as not finite
        images = np.array(data, np.float32)
    if not (np.isfinite(images).all() and np.isfinite(angles).all()):
        raise ValueError("new views hold values or angles that are not finite; nothing was changed")
    return images


def chosen(n_views: int, rng: np.random.Generator) -> int | None:
    """The view of the next step: one of the newest in every third step, else any in turn (None).

    New views must be learnt and old ones not forgotten (the rule of on-the-fly mapping; Meuleman et al. 2025).
    """
    newest = max(1, int(n_views * _NEWEST))
    if newest >= n_views or rng.random() >= 1 / 3:
        return None
    return int(rng.integers(n_views - newest, n_views))


def held_out(view: int) -> bool:
    """Whether the view of this number is not learnt before the last round: it judges the volumes so far."""
    return view % _ONE_IN == _ONE_IN // 2


def span(theta: NDArray[np.float64]) -> float:
    """The angle that views cover, modulo π: π less the widest gap."""
    ordered = np.sort(np.mod(theta, np.pi))
    return float(np.pi - np.diff(ordered, append=ordered[0] + np.pi).max())


def shift_with_axis(theta: NDArray[np.float64], moved: float) -> NDArray[np.float32]:
    """The shift (x, y) of all points that best matches a shift of the axis by `moved` in the views at `theta`.

    With an axis off by d a point appears at x cos θ + y sin θ + d. The shift (a, b) makes a cos θ + b sin θ nearest to
    d: (0, 4 d / π) for evenly spread views.
    """
    across = np.stack((np.cos(theta), np.sin(theta)), 1)
    return np.linalg.lstsq(across, np.full(theta.size, moved), rcond=None)[0].astype(np.float32)
