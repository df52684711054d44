"""Masked pixels: filled from their neighbours, so that bad values do not spread, with weight 0 in a fit."""

from __future__ import annotations

import math

import numpy as np
import scipy
from numpy.typing import NDArray

from recon.base.arrays import F32, Mask, some_values
from recon.base.jit import njit

Image = NDArray[np.float32]
Fill = tuple[NDArray[np.int32], NDArray[np.intp], NDArray[np.intp]]
"""The number of the ring of each pixel [row, col], counted from outside (0: not masked), and the rows and columns of
the masked pixels in the order of their rings."""


def plan_fill(mask: Mask) -> Fill:
    """Order in which to fill masked pixels: ring by ring from outside, each pixel from neighbours that are filled
    earlier.

    Raises:
        ValueError: all pixels [row, col] are masked.
    """
    if mask.all():
        raise ValueError(
            f"all {mask.size} pixels are masked or not finite, so there are no values from which these "
            "pixels could be filled"
        )
    ring = scipy.ndimage.distance_transform_cdt(mask, "chessboard")
    r, c = np.nonzero(mask)
    order = np.argsort(ring[r, c], kind="stable")
    return ring, r[order], c[order]


def areas(mask: Mask) -> Mask:
    """Masked pixels [row, col] in areas of 3 x 3 pixels or more. Pixels outside the detector count as masked.

    Their fill values are guesses, whereas a single pixel or a line is interpolated well.
    """
    full = np.pad(mask, 1, constant_values=True)
    return np.asarray(scipy.ndimage.binary_opening(full, np.ones((3, 3)))[1:-1, 1:-1] & mask)


def fill(image: Image, plan: Fill) -> None:
    """Fill the masked pixels of `plan` (see `plan_fill`), in place."""
    filled = np.ascontiguousarray(image)
    _fill(filled, *plan)
    if filled is not image:
        image[...] = filled


@njit(nogil=True, cache=True)
def _fill(image, ring, r, c):  # type: ignore[no-untyped-def]
    """Fill pixels in this order, each with the mean of its neighbours in rings further out."""
    rows, cols = image.shape
    near = np.zeros(8, np.float32)
    for i in range(r.size):
        known, at = 0, 0
        for row in range(r[i] - 1, r[i] + 2):
            for col in range(c[i] - 1, c[i] + 2):
                if row == r[i] and col == c[i]:
                    continue
                near[at] = 0
                if 0 <= row < rows and 0 <= col < cols and ring[row, col] < ring[r[i], c[i]]:
                    near[at] = image[row, col]
                    known += 1
                at += 1
        sums = (near[0] + near[1]) + (near[2] + near[3]), (near[4] + near[5]) + (near[6] + near[7])
        image[r[i], c[i]] = (sums[0] + sums[1]) / known


def masked(
    projections: NDArray[np.float32], weight: NDArray[np.float32] | None = None, largest: float = math.inf
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Projections in which all values are finite, and their weights.

    Pixels that are not finite, or have weight 0, get the mean of their neighbours in the same projection. Direct
    methods and first volumes use this mean. A fit ignores these pixels, because their weight is set to 0.

    Args:
        projections: [view, row, col]; not changed.
        weight: weight of each ray, 0 or more, [view, row, col]; None: 1 for all.
        largest: values beyond ± this count as not finite.

    Returns:
        Projections and weights. If no pixel was filled, the projections are the given array. The weights are None if
        all are 1.

    Raises:
        ValueError: weights are negative, not finite or have another shape, or a projection has no usable value.
    """
    if weight is not None:
        if weight.shape != projections.shape:
            raise ValueError(f"weights have shape {weight.shape}, the projections {projections.shape}")
        if not (np.isfinite(weight).all() and weight.min(initial=0) >= 0):
            raise ValueError("weights must be finite and 0 or more")
    most = min(largest, float(np.finfo(np.float32).max))

    def bad(view: int) -> Mask:
        image = projections[view]
        outside = ~((image >= -most) & (image <= most))
        return outside if weight is None else outside | (weight[view] == 0)

    counts = np.array([np.count_nonzero(bad(view)) for view in range(len(projections))])
    affected, empty = np.flatnonzero(counts), np.flatnonzero(counts == projections.shape[1] * projections.shape[2])
    if affected.size == 0:
        return projections, weight
    if empty.size:
        within = "finite" if math.isinf(largest) else f"finite, within ±{largest:.3g}"
        raise ValueError(
            f"leave out {empty.size} of {len(projections)} projections (numbers {empty[:8].tolist()} ...): they "
            f"contain no usable value. A usable value is {within}, and has a weight above 0"
        )
    filled = np.array(projections, np.float32)
    known = np.ones(projections.shape, np.float32) if weight is None else np.array(weight, np.float32)
    for view in affected.tolist():
        hidden = bad(view)
        fill(filled[view], plan_fill(hidden))
        known[view][hidden] = 0
    return filled, known


def usual_weight(weights: F32, data: F32) -> float:
    """The weight of a typical ray through the sample: the mean over rays with weight, weighted by line integrals.

    Rays past the sample may have the largest weights, for example if weights follow photon numbers. With a plain mean,
    total variation would then dominate in the sample.
    """
    top = max(float(np.percentile(some_values(data, 100_003), 99)), 0.0)
    depths, weighed = 0.0, 0.0
    for view, weight in zip(data, weights, strict=True):
        depth = np.clip(view, 0, top) * (weight > 0)
        depths += float(depth.sum(dtype=np.float64))
        weighed += float((depth * weight).sum(dtype=np.float64))
    return weighed / depths if depths > 0 else float(np.mean(weights[weights > 0], dtype=np.float64))
