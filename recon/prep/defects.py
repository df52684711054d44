"""Pixels that cannot be trusted: dead and hot ones in all views, and zingers in single ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.base.arrays import MEDIAN, Mask, median_deviation
from recon.base.masks import NEIGHBOURS, Image

_DIM, _SURE = 0.05, 3.0  # of the light that no view reaches in a shadow, and standard errors of its median
SHADOW_REACH = 5  # Rows and columns around a pixel that decide whether it lies in a shadow, beside its own row
_SORT_8 = (
    *((0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7), (0, 1), (2, 3), (4, 5), (6, 7), (2, 4), (3, 5)),
    *((1, 4), (3, 6), (1, 2), (3, 4), (5, 6)),
)
"""A network of exchanges that sorts eight values (Knuth 1998, section 5.3.4)."""
_UNLIT = 0.01  # of the light on well-lit pixels: below it a pixel is unlit


def dead_pixels(dark: Image, flats: Sequence[Image], hot_threshold: float = 10.0) -> Mask:
    """Mask [row, col] of unusable pixels: not finite, blind or unlit (flat near dark), or unlike their neighbours.

    Raises:
        ValueError: where more than half of the detector is dead: no beam, or darks and flats exchanged.
    """
    dark = np.asarray(dark, np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        nets = [np.asarray(flat, np.float32) - dark for flat in flats]
    dead = np.logical_or.reduce([~((net > 0) & np.isfinite(net)) for net in nets])
    if dead.mean() > 0.5:
        raise ValueError(
            f"{dead.mean():.0%} of the pixels have flat <= dark (median flat {np.median(flats[0]):.4g}, "
            f"median dark {np.median(dark):.4g}): no beam in the flats, or darks and flats exchanged"
        )
    # Behind a slit, flat and view are both noise, and their ratio has no meaning.
    dead = np.logical_or.reduce([dead, *(net < _UNLIT * np.percentile(net[~dead], 90) for net in nets)])
    response = np.median([np.median(net[~dead]) for net in nets])

    def outliers(image: Image, least: float) -> Mask:
        filled = np.where(dead, np.median(image[~dead]), image)
        difference = filled - ndimage.median_filter(filled, 3, mode="nearest")
        return np.abs(difference) > hot_threshold * max(median_deviation(difference), least)

    # Smaller deviations (dark below 1 % of the beam, response below 10 %) are corrected by the division.
    hot = outliers(dark, 1e-3 * float(response))
    for net in nets:
        filled = np.where(dead, response, net)
        hot |= outliers(filled / ndimage.median_filter(filled, 3, mode="nearest"), 0.01)
    return dead | hot


def shadowed(light: NDArray[np.float32], floor: float = 1e-4) -> Mask:
    """Mask [row, col] of areas that are lit in the flats but in no view: a part of the instrument is in the beam.

    Only runs of dark pixels from an edge of their row count, and rows that are dark as a whole. An opaque rod on the
    rotation axis darkens the middle, which does not count. Opaque matter that covers an edge in all views counts: its
    line integrals are not measured either way. Two pixels beside an area belong to it: its blurred edge.

    Args:
        light: float32 [view, row, col], transmission of views all around, three at least.
        floor: lowest transmission that counts as light.
    """
    n = len(light)
    middle = np.median(light, axis=0)
    spread = np.median(np.abs(light - middle), axis=0) / MEDIAN
    dark = middle < np.maximum(floor, _SURE * spread / np.sqrt(n))
    dark &= np.partition(light, n - 2, axis=0)[n - 2] < _DIM  # one view may have a zinger
    block = np.ones((3, 3))
    dark = ndimage.binary_opening(ndimage.binary_closing(np.pad(dark, 2, mode="edge"), block), block)[2:-2, 2:-2]
    left, right = (np.logical_and.accumulate(side, axis=1) for side in (dark, dark[:, ::-1]))
    found = left | right[:, ::-1]
    return np.asarray(ndimage.binary_dilation(found, np.ones((5, 5))))


def _around(image: Image, r: NDArray[np.intp], c: NDArray[np.intp]) -> tuple[Image, Image]:
    """Median and third brightest of the eight neighbours of each (r, c); at the image's edge the brightest."""
    rows, cols = image.shape
    edge = (r == 0) | (r == rows - 1) | (c == 0) | (c == cols - 1)
    if edge.all():
        return _around_edge(image, r, c)
    steps = NEIGHBOURS[:, 0] * cols + NEIGHBOURS[:, 1]
    values = [image.ravel().take(r * cols + c + step, mode="clip") for step in steps]
    for i, j in _SORT_8:
        values[i], values[j] = np.minimum(values[i], values[j]), np.maximum(values[i], values[j])
    middle, brightest = (values[3] + values[4]) / 2, values[5]
    if edge.any():
        middle[edge], brightest[edge] = _around_edge(image, r[edge], c[edge])
    return middle, brightest


def _around_edge(image: Image, r: NDArray[np.intp], c: NDArray[np.intp]) -> tuple[Image, Image]:
    """`_around` where some neighbours may lie beyond the edge."""
    rows, cols = image.shape
    nr, nc = r[:, None] + NEIGHBOURS[:, 0], c[:, None] + NEIGHBOURS[:, 1]
    inside = (nr >= 0) & (nr < rows) & (nc >= 0) & (nc < cols)
    values = np.where(inside, image[np.clip(nr, 0, rows - 1), np.clip(nc, 0, cols - 1)], np.float32(np.nan))
    values.sort(axis=1)  # NaN, for places outside, come last
    n, at = inside.sum(axis=1), np.arange(r.size)
    return (values[at, (n - 1) // 2] + values[at, n // 2]) / 2, values[at, np.where(n == 8, 5, n - 1)]


def zingers(view: Image, others: list[Image], threshold: float) -> tuple[NDArray[np.intp], NDArray[np.intp], Image]:
    """Pixels (r, c) hit by a stray photon, and the median around each.

    Compared in √transmission, where photon noise is uniform. A bright feature of the sample is also in the neighbouring
    views, or is larger than the two or three pixels of a zinger. A zinger is brighter than both.
    """
    root = np.sqrt(np.maximum(view, 0))
    step = max(1, int(np.sqrt(view.size / 4096)))
    r, c = (a.ravel() for a in np.meshgrid(*(np.arange(0, n, step) for n in view.shape), indexing="ij"))
    spread = root[r, c] - _around(root, r, c)[0]
    limit = threshold * max(median_deviation(spread), 0.005)
    before = np.sqrt(np.maximum(np.maximum.reduce(others), 0)) if others else np.zeros_like(root)
    r, c = np.nonzero(root > before + limit)
    middle, brightest = _around(root, r, c)
    spikes = root[r, c] > brightest + limit
    return r[spikes], c[spikes], middle[spikes] ** 2
