"""Selections of projections: by a text such as all, fixed:90, sector:30-150:60 or every:4, or evenly spread."""

from __future__ import annotations

import operator
import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

FORMS = "all, fixed:N, sector:A-B[:N] (degrees), random:N[:seed], first:N, every:K"

_NUMBER = r"[+-]?\d+(?:\.\d*)?"
_SECTOR = re.compile(rf"({_NUMBER})-({_NUMBER})(?::(\d+))?")
_RANDOM = re.compile(r"(\d+)(?::(\d+))?")
_COUNT = re.compile(r"\d+")


def parse_views(spec: str, angles: ArrayLike, seed: int = 0, *, period: float = np.pi) -> NDArray[np.int64]:
    """Indices of the selected projections, ascending, without repetition.

    - `all`: all projections.
    - `fixed:N`: N projections evenly spread in angle. Projections one `period` apart see the same rays. They count as
      one angle, as long as at least N angles are left.
    - `sector:A-B[:N]`: projections with A <= angle <= B degrees (modulo 360); with N, only N of these, evenly spread.
    - `random:N[:seed]`: N projections drawn without replacement.
    - `first:N`: the first N projections of the scan.
    - `every:K`: every K-th projection, in the order taken.

    Args:
        angles: [view], radians, in the order taken.
        seed: seed for `random:N` if the text contains none.
        period: radians after which projections see the same rays, see `Geometry.period`. The default is for a parallel
            beam with the axis in the middle.

    Raises:
        ValueError: the selection does not have one of these forms or asks for more projections than there are, or an
            angle is not finite.
    """
    theta = np.asarray(angles, np.float64)
    if not np.isfinite(theta).all():
        raise ValueError(
            f"projections {np.flatnonzero(~np.isfinite(theta))[:8].tolist()} have no angle; leave them out first"
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
        f"unknown selection of projections {spec!r}. Use one of: {FORMS}. To leave out frames of a scan file, use for "
        "example --frames none=30:38+61:62"
    )


def _enough(n: int, available: int, spec: str) -> int:
    if not 1 <= n <= available:
        raise ValueError(
            f"{spec!r} asks for {n} projections, and {available} are available; give a number from 1 to {available}"
        )
    return n


def _sector(
    theta: NDArray[np.float64], low: float, high: float, count: str | None, spec: str, period: float
) -> NDArray[np.int64]:
    if not high > low:
        raise ValueError(
            f"{spec!r}: the sector must end at a larger angle than it begins, but {high:g} is not above {low:g} degrees"
        )
    slack = 1e-6  # degrees, so that a projection at an end of the sector is inside
    from_low = np.mod(np.rad2deg(theta) - low + slack, 360)
    inside = np.flatnonzero(from_low <= high - low + 2 * slack)
    if not inside.size:
        degrees = np.rad2deg(theta)
        raise ValueError(
            f"{spec!r} contains no projection; the {theta.size} projections are at {degrees.min():.2f} to "
            f"{degrees.max():.2f} degrees"
        )
    if count is None:
        return inside
    return _even(inside, theta, _enough(int(count), inside.size, spec), period)


def _even(views: NDArray[np.int64], theta: NDArray[np.float64], n: int, period: float) -> NDArray[np.int64]:
    """n of the projections, evenly spread over the distinct angles in a period, or over all projections if the distinct
    angles are too few."""
    within_period = np.sort(np.mod(theta[views], period))
    gaps = np.diff(within_period, append=within_period[0] + period)
    step = float(np.median(gaps[gaps > 1e-9]))
    angle_from_first = np.mod(theta[views] - theta[views[0]] + 0.05 * step, period)  # counted from the first projection
    order = np.argsort(angle_from_first, kind="stable")
    first_of_step = np.flatnonzero(np.diff(angle_from_first[order], prepend=-np.inf) > 0.1 * step)
    # the earliest projection at each angle
    distinct = np.minimum.reduceat(order, first_of_step) if first_of_step.size >= n else order
    return np.sort(views[distinct[np.arange(n) * distinct.size // n]])


def spread_views(angles: NDArray[np.float64], n: int, frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """At most `n` of the frames, evenly spread. For a 360° scan, n / 2 frames, each with its opposite projection.

    Args:
        angles: [frame], radians.
        frames: [frame], their indices in the file.
    """
    all_numbers = np.arange(angles.size)
    if angles.size <= n:
        return frames
    if np.ptp(angles) < 1.5 * np.pi:
        return frames[spread(all_numbers, n)]
    spread_half = spread(all_numbers, n // 2)
    distances = np.abs(np.mod(angles[spread_half][:, None] - angles + np.pi, 2 * np.pi) - np.pi)
    return frames[np.union1d(spread_half, distances.argmax(axis=1))]


def spread(items: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """At most `n` of the items [item], evenly spread, including the first and the last."""
    if items.size <= n:
        return items
    return items[np.unique(np.linspace(0, items.size - 1, n).round().astype(np.int64))]


def used_views(n_views: int, held_out: Sequence[int]) -> NDArray[np.bool_]:
    """[view] False for the projections with these numbers, which are held out.

    Raises:
        ValueError: a number is not that of a projection, or all projections are held out.
    """
    kept_back = np.unique(np.array([operator.index(view) for view in held_out], np.intp))
    if kept_back.size and not (kept_back[0] >= 0 and kept_back[-1] < n_views):
        raise ValueError(f"held_out must be projection numbers 0 to {n_views - 1}, got {kept_back[[0, -1]].tolist()}")
    if kept_back.size >= n_views:
        raise ValueError(
            f"all {n_views} projections are held out, so no projection is left for the fit; hold out fewer projections"
        )
    return ~np.isin(np.arange(n_views), kept_back)
