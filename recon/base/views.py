"""Selections of views: by a short form such as all, fixed:90, sector:30-150:60 or every:4, and evenly spread ones."""

from __future__ import annotations

import operator
import re

import numpy as np
from numpy.typing import ArrayLike, NDArray

FORMS = "all, fixed:N, sector:A-B[:N] (degrees), random:N[:seed], first:N, every:K"

_NUMBER = r"[+-]?\d+(?:\.\d*)?"
_SECTOR = re.compile(rf"({_NUMBER})-({_NUMBER})(?::(\d+))?")
_RANDOM = re.compile(r"(\d+)(?::(\d+))?")
_COUNT = re.compile(r"\d+")


def parse_views(spec: str, angles: ArrayLike, seed: int = 0, *, period: float = np.pi) -> NDArray[np.int64]:
    """Indices of the selected views, ascending, without repetition.

    - `all`: every view.
    - `fixed:N`: N views spread evenly in angle. Views one `period` apart see the same rays and count as one angle, as
      long as N angles are left.
    - `sector:A-B[:N]`: views with A <= angle <= B degrees (modulo 360); of these, N spread evenly.
    - `random:N[:seed]`: N views drawn without replacement.
    - `first:N`: the N views taken first.
    - `every:K`: one of K views, in the order taken.

    Args:
        angles: [view], radians, in the order taken.
        seed: for `random:N` without a seed in the text.
        period: radians after which views see the same rays, see `Geometry.period`; by default those of a parallel beam
            with the axis in the middle.

    Raises:
        ValueError: for a selection that is not one of these forms, or that asks for more views than there are; for
            angles that are not finite.
    """
    theta = np.asarray(angles, np.float64)
    if not np.isfinite(theta).all():
        raise ValueError(
            f"views {np.flatnonzero(~np.isfinite(theta))[:8].tolist()} have no angle; leave them out first"
        )
    views = np.arange(theta.size)
    name, _, rest = spec.strip().partition(":")
    if name == "all" and not rest:
        return views
    if name in ("fixed", "first") and _COUNT.fullmatch(rest):
        n = _enough(int(rest), theta.size, spec)
        return views[:n] if name == "first" else _even(views, theta, n, period)
    if name == "every" and _COUNT.fullmatch(rest) and int(rest) > 0:
        return views[:: int(rest)]
    if name == "random" and (match := _RANDOM.fullmatch(rest)):
        n = _enough(int(match[1]), theta.size, spec)
        rng = np.random.default_rng(seed if match[2] is None else int(match[2]))
        return np.sort(rng.choice(views, n, replace=False))
    if name == "sector" and (match := _SECTOR.fullmatch(rest)):
        return _sector(theta, float(match[1]), float(match[2]), match[3], spec, period)
    raise ValueError(
        f"unknown selection of views {spec!r}; use one of: {FORMS}; of a scan file, --frames none=30:38+61:62 leaves "
        "these frames out"
    )


def _enough(n: int, available: int, spec: str) -> int:
    if not 1 <= n <= available:
        raise ValueError(f"{spec!r} asks for {n} views; give a number from 1 to {available}")
    return n


def _sector(
    theta: NDArray[np.float64], low: float, high: float, count: str | None, spec: str, period: float
) -> NDArray[np.int64]:
    if not high > low:
        raise ValueError(f"{spec!r}: the sector must end after it begins, {high:g} is not above {low:g} degrees")
    slack = 1e-6  # degrees, so that a view at an end of the sector is inside
    from_low = np.mod(np.rad2deg(theta) - low + slack, 360)
    inside = np.flatnonzero(from_low <= high - low + 2 * slack)
    if not inside.size:
        degrees = np.rad2deg(theta)
        raise ValueError(
            f"{spec!r} holds no view; the {theta.size} views lie at {degrees.min():.2f} to {degrees.max():.2f} degrees"
        )
    if count is None:
        return inside
    return _even(inside, theta, _enough(int(count), inside.size, spec), period)


def _even(views: NDArray[np.int64], theta: NDArray[np.float64], n: int, period: float) -> NDArray[np.int64]:
    """n of the views, spread evenly over the distinct angles within a period, or over all if these are too few."""
    once = np.sort(np.mod(theta[views], period))
    gaps = np.diff(once, append=once[0] + period)
    step = float(np.median(gaps[gaps > 1e-9]))
    place = np.mod(theta[views] - theta[views[0]] + 0.05 * step, period)  # counted from the first view
    order = np.argsort(place, kind="stable")
    starts = np.flatnonzero(np.diff(place[order], prepend=-np.inf) > 0.1 * step)
    distinct = np.minimum.reduceat(order, starts) if starts.size >= n else order  # the earliest view at each angle
    return np.sort(views[distinct[np.arange(n) * distinct.size // n]])


def spread_views(angles: NDArray[np.float64], n: int, frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """At most `n` of the frames, evenly spread; of a full turn half as many, each with the opposite one.

    Args:
        angles: [frame], radians.
        frames: [frame], their rows in the file.
    """
    every = np.arange(angles.size)
    if angles.size <= n:
        return frames
    if np.ptp(angles) < 1.5 * np.pi:
        return frames[spread(every, n)]
    some = spread(every, n // 2)
    away = np.abs(np.mod(angles[some][:, None] - angles + np.pi, 2 * np.pi) - np.pi)
    return frames[np.union1d(some, away.argmax(axis=1))]


def spread(items: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """At most `n` of the items [item], evenly spread, including the first and the last."""
    if items.size <= n:
        return items
    return items[np.unique(np.linspace(0, items.size - 1, n).round().astype(np.int64))]


def used_and_kept_back(
    n_views: int, held_out: tuple[int, ...], early_stop: bool
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Numbers of the views that a fit sees, and of those held out, ascending.

    Raises:
        ValueError: numbers that name no view, or all of them; none where `early_stop` needs some.
    """
    kept_back = np.unique(np.array([operator.index(view) for view in held_out], np.intp))
    if kept_back.size and not (kept_back[0] >= 0 and kept_back[-1] < n_views):
        raise ValueError(f"held_out must name views 0 to {n_views - 1}, got {kept_back[[0, -1]].tolist()}")
    if kept_back.size >= n_views:
        raise ValueError(f"all {n_views} views are held out: none is left for the fit")
    if early_stop and not kept_back.size:
        raise ValueError("early_stop needs held-out views, and there are none")
    return np.setdiff1d(np.arange(n_views), kept_back), kept_back
