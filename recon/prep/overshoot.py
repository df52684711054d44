"""Overshoot: outer edges of a sample beside which line integrals fall below the air, as fringes of a wave make them.

A blur, noise, and rays through voxels above zero leave the air beside an edge at the level of the air farther away, or
above it. A wave on its way to the detector takes it below. So does a filter that sharpens.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.base.arrays import F32, I64, median_deviation
from recon.base.views import spread

_LEVELS = 1, 4, 16  # rows averaged on either side of the comparison: a can shows one edge in all, grains one in each
_VIEWS, _BLOCKS, _TURN = 96, 16, 16  # looked at, of each level; views also averaged, as a can is alike from all sides
_AIR, _NEAR = 6, 3  # columns of air that an edge needs, and those next to it, where the overshoot is sought
_EDGE, _OF_DEEPEST = 6.0, 0.02  # times the noise, and of the deepest line integrals, where it begins
_FEWEST, _AGREE, _SIGMAS = 6, 2.0, 6.0  # places of edges; standard errors, by how places agree, by the air's noise
SHARE = 0.01
"""Of an edge's step, by which line integrals beside it must lie below the air."""


@dataclass(frozen=True)
class Overshoot:
    """By how much line integrals beside outer edges lie below the air farther away.

    Attributes:
        share: of the edge's step.
        sigmas: the same in standard errors, by the noise of the air, where edges at different places agree on it.
    """

    share: float = 0.0
    sigmas: float = 0.0

    @property
    def certain(self) -> bool:
        return self.sigmas > _SIGMAS and self.share > SHARE

    @classmethod
    def of(cls, views: F32) -> Overshoot:
        """The most significant overshoot in line integrals [view, row, col]; none where no edge is beside air.

        An edge is sought in every other row and measured in the rows between, so that noise, of a ring too, does not
        choose what is measured. Edges in one column of the same rows count once.
        """
        most, some = cls(), spread(np.arange(len(views)), _VIEWS)
        for n in _LEVELS:
            blocks = spread(np.arange(views.shape[1] // (2 * n)), _BLOCKS)
            if blocks.size and views.shape[2] >= 4 * _AIR:
                rows = (blocks[:, None] * 2 * n + np.arange(2 * n)).ravel()
                halves = np.stack([views[view][rows].reshape(-1, n, 2, views.shape[2]).mean(axis=1) for view in some])
                turns = np.stack([each.mean(axis=0) for each in np.array_split(halves, -(-len(halves) // _TURN))])
                most = max(most, _overshoot(halves), _overshoot(turns), key=lambda each: each.sigmas)
        return most

    def in_words(self) -> str:
        return (
            f"Beside outer edges of the sample, line integrals lie {self.share:.1%} of the edge's step below the air, "
            "which no blur and no noise does: phase fringes, or views that were sharpened."
        )


def _overshoot(halves: F32) -> Overshoot:
    """Of line integrals [view, block, half of the rows, col]."""
    edges = [
        _edges(halves[:, :, half, ::way], halves[:, :, 1 - half, ::way], 2 * half + (way > 0))
        for half in (0, 1)
        for way in (1, -1)
    ]
    rays, place = (np.concatenate(parts) for parts in zip(*edges, strict=True))
    at = np.unique(place, return_inverse=True)[1]
    places = int(at.max(initial=-1)) + 1
    if places < _FEWEST:
        return Overshoot()
    below = rays[:, 1 + _NEAR :].mean(axis=1, dtype=np.float64)[:, None] - rays
    mean = below.mean(axis=0)
    scatter = np.square([np.bincount(at, column) for column in (below - mean).T]).sum(axis=1) * places / (places - 1)
    errors = np.sqrt(scatter[1 : 1 + _NEAR]) / len(below) + 1e-9
    noise = np.sqrt(2 * scatter[1 + _NEAR :].mean()) / len(below) + 1e-9  # beside the mean of three columns
    sigmas = np.where(mean[1 : 1 + _NEAR] > _AGREE * errors, mean[1 : 1 + _NEAR] / noise, 0)
    k = int(sigmas.argmax())
    return Overshoot(float(mean[1 + k] / -mean[0]), float(sigmas[k])) if mean[0] < 0 < sigmas[k] else Overshoot()


def _edges(sought: F32, measured: F32, kind: int) -> tuple[F32, I64]:
    """Line integrals outwards [edge, column] from the pixel inside each first edge, and the place of each [edge].

    Args:
        sought, measured: line integrals [view, row, col], by which edges are found, and which are returned. An edge is
            the steepest step where the air ends.
        kind: is part of the place.
    """
    sought = sought - sought[:, :, :_AIR].mean(axis=2, keepdims=True)
    noisy = _EDGE * median_deviation(np.diff(sought[:, :, :_AIR], axis=2)) / np.sqrt(2)
    matter = sought > max(noisy, _OF_DEEPEST * float(np.percentile(sought, 98)))
    view, row = np.nonzero(~matter[:, :, : _AIR + 1].any(axis=2) & matter[:, :, : sought.shape[2] // 2].any(axis=2))
    first = matter[view, row].argmax(axis=1)
    around = np.take_along_axis(sought[view, row], first[:, None] + np.arange(-2, 3), axis=1)
    first = first - 1 + np.diff(around, axis=1).argmax(axis=1)  # the steepest step near where matter is seen
    rays = np.take_along_axis(measured[view, row], first[:, None] + np.arange(1, -_AIR - 1, -1), axis=1)
    return rays, (row * sought.shape[2] + first) * 4 + kind
