"""Steadiness: what stays in the columns of sinograms through all views, by which stripes are told from the sample."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, median_deviation
from recon.base.noise import mirrored

NARROWEST = 64  # columns; in 40 columns the methods that remove stripes add more than they remove
_SEEN = 3.5  # `Steadiness.score` from which on there are stripes: 0.3 to 2.7 without, 4.4 and 5.3 in two real scans
_ONE_SIDED = 0.5  # of pixels' answers the odd part equals the even one; layers of the sample have hardly any
_BLOCKS, _BLOCK = 8, 8  # contiguous blocks of views, and views of the smallest one
AT_AXIS = 4.0  # Columns on either side: a body this small on the axis looks like a ring
_FEWEST_PAIRS = 20  # mirrored columns


@dataclass(frozen=True)
class Steadiness:
    """What stays in the columns of a sinogram through all views, as standard deviations of fine differences.

    A layer of the sample around the axis stays in its columns, too, but in those on both sides of the axis alike. The
    answer of a pixel knows nothing of the pixel on the other side. So stripes are odd about the axis as much as they
    are even, and only those of the sample are even alone.

    Attributes:
        odd, even: parts of the mean over blocks of views.
        noise: of the odd part, by how it differs between the blocks.
    """

    odd: float
    even: float
    noise: float

    @property
    def score(self) -> float:
        """The odd part in units of its noise; about 1 without stripes."""
        return self.odd / max(self.noise, 1e-12)

    @property
    def stripes(self) -> bool:
        """Whether pixels answer unequally."""
        return self.score > _SEEN and self.odd > _ONE_SIDED * self.even


def steadiness(sinograms: F32, axis_col: float) -> Steadiness | None:
    """How steady and how one-sided the columns of sinograms are; None: too few columns have a mirrored one.

    Args:
        sinograms: [view, row, col] in the order of the angles.
        axis_col: column of the rotation axis.
    """
    n, rows, cols = sinograms.shape
    blocks = np.array_split(np.arange(n), min(max(n // _BLOCK, 2), _BLOCKS))
    right = np.arange(math.ceil(axis_col + AT_AXIS), cols)
    right = right[2 * axis_col - right >= 0]
    if right.size < _FEWEST_PAIRS:
        return None
    fine = np.stack([[_fine(sinograms[block, row]) for row in range(rows)] for block in blocks])
    own, across = fine[..., right], mirrored(fine, axis_col)[..., right]
    odd, even = (own - across) / math.sqrt(2), (own + across) / math.sqrt(2)
    mean = odd.mean(axis=0)
    noise = median_deviation(odd - mean) / math.sqrt(len(blocks) - 1)
    return Steadiness(median_deviation(mean), median_deviation(even.mean(axis=0)), noise)


def _fine(sinogram: F32) -> NDArray[np.floating]:
    """[col] how a column differs from the four beside it in most views, without what bends slowly along the row."""
    x = np.pad(sinogram, ((0, 0), (2, 2)), mode="edge")
    off = np.median(x[:, 2:-2] - (x[:, :-4] + x[:, 1:-3] + x[:, 3:-1] + x[:, 4:]) / 4, axis=0)
    return np.asarray(np.convolve(off, (-0.5, 1, -0.5), mode="same"))
