"""learn_geometry: from line integrals and a geometry to a better one, from coarse to fine pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32
from recon.base.binning import bin_views
from recon.base.geometry import Geometry
from recon.calibration.freedom import Change
from recon.calibration.joint import JointFit

_LEAST_VIEWS = 12
_FIRST = 6  # rounds of conjugate gradients on the volume alone
_ROUNDS = 8
_STEPS = 8, 5, 4  # of Gauss-Newton at each binning, from coarse to fine
_COARSEST = 24  # columns


@dataclass(frozen=True, eq=False)
class Learnt:
    """What was learnt of a geometry.

    Attributes:
        change: in pixels of the views.
        said: a sentence.
        parameters: for the file of a volume, by name.
    """

    change: Change
    said: str
    parameters: Mapping[str, NDArray[np.float64] | float | str]


def learn_geometry(
    projections: F32,
    geometry: Geometry,
    terms: frozenset[str],
    progress: Callable[[int, int], None] = lambda n, total: None,
    known: F32 | None = None,
) -> Learnt:
    """The geometry by which a volume explains the views best, as far as the views can tell it.

    Args:
        projections: [view, row, col], line integrals; some 200 columns and 64 rows are enough.
        terms: what may change, of `freedom.TERMS`.
        progress: steps done, and steps at most.
        known: [row, col] weights of pixels; None: one for all.

    Raises:
        ValueError: fewer than twelve views.
    """
    if geometry.n_views < _LEAST_VIEWS:
        raise ValueError(f"{geometry.n_views} views are too few; {_LEAST_VIEWS} are needed")
    rows, cols = geometry.detector_shape
    factors = [f for f in (4, 2, 1) if f == 1 or (cols // f >= _COARSEST and rows // f >= 1)]
    steps = _STEPS[-len(factors) :]
    found, total, done = geometry, sum(steps), 0
    for factor, count in zip(factors, steps, strict=True):
        small = found.binned(factor)
        data = bin_views(projections, factor)
        weights = None if known is None else np.broadcast_to(bin_views(known[None], factor), data.shape)
        fit = JointFit.of(data, small, terms, weights)
        fit.step(_FIRST, 0.0)
        for _ in range(count):
            fit.step(_ROUNDS, 2.0)
            done += 1
            progress(done, total)
        found = Change.between(small, fit.geometry).scaled(factor).applied(found)
    change = Change.between(geometry, found)
    text = (
        f"Geometry learnt: the axis moves by {change.axis:+.2f} px, roll {math.degrees(change.roll):+.3f}°, tilt "
        f"{math.degrees(change.tilt):+.3f}°, views by up to {np.abs(change.shifts).max():.2f} px."
    )
    return Learnt(change, text, {"calibrate_axis_px": change.axis})
