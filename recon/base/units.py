"""Units: warns if angles are in degrees instead of radians, or projections are counts or transmission."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import median_deviation, some_values
from recon.base.views import spread

HC = 1.239841984e-6  # keV mm: product of wavelength in mm and photon energy (CODATA 2018)
_MOST_TURNS = 10  # fewer turns are plausible in radians, unless all angles are whole numbers
_LEAST_VIEWS = 5  # with fewer projections there is no warning
_ROUND = 0.01  # tolerance, as a share of 360° or 180°
_OPAQUE = 15.0  # line integral; no detector measures a transmission of exp(-15) in nine of ten pixels
_SAMPLED_VALUES = 2**16  # number of values in the sample
_VIEWS, _ROWS, _VALUES = 32, 64, 2**21  # size of the sample in which transmission is searched for
# tolerance of the beam level in transmission: its difference from 1, and its difference between projections
_LEVEL = 0.15
_NOT_ABOVE = 0.03  # share of the beam; nine values in ten are at most this much above it
_COLUMNS_PER_EDGE = 32  # one of this many columns belongs to an edge
_SIGMAS = 3.0


def look_like_degrees(angles: NDArray[np.floating], ended: bool = True) -> bool:
    """Whether angles [view] given as radians look like degrees.

    Angles look like degrees in three cases: all are whole numbers; they span 180 or 360; or they span more than ten
    turns (in radians) and are rounded to two digits. Before a scan has `ended`, the span is not used, because a scan of
    many turns passes 180 rad.
    """
    distinct = np.unique(angles)
    if distinct.size < _LEAST_VIEWS or not np.isfinite(distinct).all():
        return False
    span = float(distinct[-1] - distinct[0])
    if span >= _LEAST_VIEWS - 1 and np.array_equal(distinct, np.round(distinct)):
        return True
    if span <= 2 * np.pi * _MOST_TURNS:
        return False
    round_numbers = np.allclose(distinct * 100, np.round(distinct * 100), rtol=0, atol=1e-3)
    whole = span + span / (distinct.size - 1)
    is_whole_turn = ended and any(abs(s / turn - 1) < 1e-3 for s in (span, whole) for turn in (180, 360))
    return bool(round_numbers or is_whole_turn)


def gone_round(angles: NDArray[np.floating], turn: float) -> float:
    """Half a `turn` or a whole `turn`, whichever the distinct angles [view] cover (with or without the last angle); 0
    if they cover neither."""
    span = float(np.ptp(angles)) if angles.size >= _LEAST_VIEWS else 0.0
    spans = span, span + span / max(angles.size - 1, 1)
    return next((part for part in (turn / 2, turn) if min(abs(each / part - 1) for each in spans) < _ROUND), 0.0)


def warn_of_degrees(angles: NDArray[np.floating], ended: bool = True) -> None:
    """Give a UserWarning if angles look like degrees. The warning names the line that called the calling function."""
    if look_like_degrees(angles, ended):
        warnings.warn(
            f"angles must be in radians. The given angles reach {np.abs(angles).max():.5g} and look like degrees: "
            "give np.deg2rad(angles)",
            stacklevel=3,
        )


def look_like_counts(projections: NDArray[np.floating]) -> bool:
    """Whether values [view, row, col] given as line integrals look like counts. A sample of the values is tested.

    Values look like counts if nine in ten of them are so large that no detector could measure the remaining intensity.
    If all values are whole numbers, half of them being so large is enough.
    """
    sampled = some_values(projections, _SAMPLED_VALUES)
    sampled = sampled[np.isfinite(sampled)]
    if sampled.size == 0 or not np.median(sampled) > _OPAQUE:
        return False
    return bool(np.quantile(sampled, 0.1) > _OPAQUE or np.array_equal(sampled, np.round(sampled)))


def look_like_transmission(projections: NDArray[np.floating]) -> bool:
    """Whether values [view, row, col] given as line integrals look like transmission. A sample of them is tested.

    In air, line integrals are 0 and transmission is 1. In the sample, line integrals are higher and transmission is
    lower. So the values are transmission if five conditions hold: half of the left and right edges have a level near 1;
    these edges are flat; nine values in ten are not above that level; no value is much below 0; and the middle is below
    the level. Line integrals of a sample within the field of view never meet these conditions. If a sample fills the
    field of view, line integrals of about 1 at the edges and lower ones between them come from a tube seen from inside.
    The profile of a tube falls from the edge on, so its edges are not flat.
    """
    if projections.ndim != 3 or projections.shape[0] < 2 or not projections.shape[1] or projections.shape[2] < 16:
        return False
    views, rows, cols = projections.shape
    looked_at = max(_VIEWS, _VALUES // (min(rows, _ROWS) * cols))
    sampled = projections[spread(np.arange(views), looked_at)][:, spread(np.arange(rows), _ROWS)].astype(np.float32)
    sampled[~np.isfinite(sampled)] = np.nan
    width, middle = cols // _COLUMNS_PER_EDGE or 1, sampled[..., cols // 3 : cols - cols // 3]
    edges = np.concatenate([sampled[..., :width], sampled[..., -width:]])
    inner = np.concatenate([sampled[..., width : 2 * width], sampled[..., -2 * width : -width]])
    seen = np.isfinite(edges).any(axis=(1, 2)) & np.isfinite(inner).any(axis=(1, 2))
    if not seen.any() or not np.isfinite(middle).any():
        return False
    edges, inner = edges[seen], inner[seen]
    levels, inner_levels = (np.nanmedian(part, axis=(1, 2)) for part in (edges, inner))
    air = levels + inner_levels >= np.median(levels + inner_levels)  # the sample may reach the other edges
    beam = float(np.median(levels[air]))
    scatter = edges[air] - levels[air, None, None]
    noise = median_deviation(scatter)
    lowest, highest = np.nanquantile(sampled, (0.001, 0.9))
    if (np.abs(levels[air] - 1) > _LEVEL).any() or lowest < -_NOT_ABOVE - _SIGMAS * noise:
        return False
    if highest > levels.max() * (1 + _NOT_ABOVE) + 2 * noise:
        return False
    fall = beam - float(np.nanmean(middle))
    step = float(np.mean(levels[air] - inner_levels[air]))
    # twice the standard error of the difference of two medians at the edges
    uncertain = 2 * noise / np.sqrt(np.isfinite(edges[air]).sum())
    flat = fall / _COLUMNS_PER_EDGE  # a convex profile falls twice as much from the edge to the next columns
    return bool(step < flat and flat > max(_SIGMAS * uncertain, 1e-4 * beam))


def warn_of_other_quantity(projections: NDArray[np.floating], stacklevel: int = 3) -> None:
    """Give a UserWarning if values [view, row, col] that should be line integrals look like counts or transmission.

    Args:
        stacklevel: stacklevel of the warning; 3 names the line that called the calling function.
    """
    if look_like_counts(projections):
        warnings.warn(
            "projections must be line integrals. The given projections look like counts (median "
            f"{np.nanmedian(projections[:1]):.4g}). Convert counts with -log((counts - dark) / (flat - dark)), see "
            "recon.correct, or give recon.Counts",
            stacklevel=stacklevel,
        )
    elif look_like_transmission(projections):
        warnings.warn(
            "projections must be line integrals. The given projections look like transmission, because their values "
            "are about 1 at the left and right edges and lower in the sample. Give -np.log(transmission)",
            stacklevel=stacklevel,
        )
