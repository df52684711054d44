"""Overshoot: phase fringes, seen as line integrals below the air level next to the outer edges of the sample.

Blur, noise and a sample with positive densities do not lower the air next to an edge below the level of the air farther
away. Phase contrast lowers it, and so does a sharpening filter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.base.arrays import F32, I64
from recon.base.noise import deviation_between_neighbours
from recon.base.views import spread

# numbers of rows that are averaged; a can has the same edge in all rows, grains have a different edge in each row
_LEVELS = 1, 4, 16
MOST_VIEWS = 96  # largest number of projections examined
_BLOCKS = 16  # number of groups of rows for each level
_AVERAGED = 16  # number of neighbouring projections that are averaged, too, because a can looks the same from all sides
# number of columns of air that an edge needs; number of columns next to the edge in which the overshoot is searched
_AIR, _BESIDE = 6, 3
# material begins at this multiple of the noise and this share of the largest line integral
_EDGE, _OF_DEEPEST = 6.0, 0.02
_FEWEST = 6  # least number of edge positions
# smallest significance in standard errors, computed from the agreement between positions, and from the noise of the air
_AGREE, _ERRORS = 2.0, 6.0
SEARCH = "To remove phase fringes, use `recon --phase auto`, which searches for a phase filter."
LEAST_SHARE = 0.01
"""An overshoot below this share of the step at the edge does not count. After this value was set, 227 simulated scans
without fringes were examined once: their overshoot is at most 1.9 standard errors."""


@dataclass(frozen=True)
class Overshoot:
    """Overshoot: how far line integrals next to outer edges are below the air farther away.

    Attributes:
        share: overshoot as a share of the step at the edge.
        errors: overshoot in standard errors (from the noise of the air). 0 if edges at different positions disagree
            about the overshoot.
    """

    share: float = 0.0
    errors: float = 0.0

    @property
    def certain(self) -> bool:
        return self.errors > _ERRORS and self.share > LEAST_SHARE

    @classmethod
    def of(cls, views: F32) -> Overshoot:
        """The most significant overshoot in line integrals [view, row, col]; 0 if no edge is next to air.

        Edges are searched in every second row and measured in the rows between. So noise, or a ring, cannot select
        which pixels are measured. Edges in the same column and rows count once.
        """
        most_significant, examined_views = cls(), spread(np.arange(len(views)), MOST_VIEWS)
        for n in _LEVELS:
            blocks = spread(np.arange(views.shape[1] // (2 * n)), _BLOCKS)
            if blocks.size and views.shape[2] >= 4 * _AIR:
                rows = (blocks[:, None] * 2 * n + np.arange(2 * n)).ravel()
                halves = np.stack(
                    [views[view][rows].reshape(-1, n, 2, views.shape[2]).mean(axis=1) for view in examined_views]
                )
                averaged = np.stack(
                    [each.mean(axis=0) for each in np.array_split(halves, -(-len(halves) // _AVERAGED))]
                )
                most_significant = max(
                    most_significant, _overshoot(halves), _overshoot(averaged), key=lambda each: each.errors
                )
        return most_significant

    @classmethod
    def of_counts(cls, counts: F32, dark: F32 | float, flat: F32 | float) -> Overshoot:
        """The same for counts [view, row, col], with dark and flat [row, col]; pixels without beam count as air."""
        beam = flat - dark
        transmission = np.where(beam > 0, (counts - dark) / np.where(beam > 0, beam, 1), 1)
        return cls.of(-np.log(np.maximum(transmission, 1e-6)).astype(np.float32))

    def in_words(self) -> str:
        return (
            "The projections have phase fringes, or they were sharpened: next to the outer edges of the sample, line "
            f"integrals are lower than in air, by {self.share:.1%} of the step at the edge. Blur and noise do not make "
            "line integrals lower than in air."
        )


def _overshoot(halves: F32) -> Overshoot:
    """Overshoot of line integrals [view, block, half of the rows, col]."""
    edges = [
        _edges(halves[:, :, half, ::direction], halves[:, :, 1 - half, ::direction], 2 * half + (direction > 0))
        for half in (0, 1)
        for direction in (1, -1)
    ]
    rays, position = (np.concatenate(parts) for parts in zip(*edges, strict=True))
    position_index = np.unique(position, return_inverse=True)[1]
    n_positions = int(position_index.max(initial=-1)) + 1
    if n_positions < _FEWEST:
        return Overshoot()
    below = rays[:, 1 + _BESIDE :].mean(axis=1, dtype=np.float64)[:, None] - rays
    mean = below.mean(axis=0)
    scatter = (
        np.square([np.bincount(position_index, column) for column in (below - mean).T]).sum(axis=1)
        * n_positions
        / (n_positions - 1)
    )
    errors = np.sqrt(scatter[1 : 1 + _BESIDE]) / len(below) + 1e-9
    noise = np.sqrt(2 * scatter[1 + _BESIDE :].mean()) / len(below) + 1e-9  # compared with the mean of three columns
    significance = np.where(mean[1 : 1 + _BESIDE] > _AGREE * errors, mean[1 : 1 + _BESIDE] / noise, 0)
    k = int(significance.argmax())
    return (
        Overshoot(float(mean[1 + k] / -mean[0]), float(significance[k]))
        if mean[0] < 0 < significance[k]
        else Overshoot()
    )


def _edges(sought: F32, measured: F32, kind: int) -> tuple[F32, I64]:
    """Line integrals [edge, column], from the pixel just inside each first edge outwards, and the position of each
    edge.

    Args:
        sought: line integrals [view, row, col] in which edges are searched: the steepest step at the end of the air.
        measured: line integrals of other rows, which are returned.
        kind: number 0 to 3 for the side and the half of the rows. It is a part of the position.
    """
    sought = sought - sought[:, :, :_AIR].mean(axis=2, keepdims=True)
    threshold = _EDGE * deviation_between_neighbours(sought[:, :, :_AIR])
    material = sought > max(threshold, _OF_DEEPEST * float(np.percentile(sought, 98)))
    view, row = np.nonzero(~material[:, :, : _AIR + 1].any(axis=2) & material[:, :, : sought.shape[2] // 2].any(axis=2))
    first = material[view, row].argmax(axis=1)
    around = np.take_along_axis(sought[view, row], first[:, None] + np.arange(-2, 3), axis=1)
    first = first - 1 + np.diff(around, axis=1).argmax(axis=1)  # the steepest step near the start of the material
    rays = np.take_along_axis(measured[view, row], first[:, None] + np.arange(1, -_AIR - 1, -1), axis=1)
    return rays, (row * sought.shape[2] + first) * 4 + kind
