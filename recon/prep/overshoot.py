"""Overshoot: outer edges of a sample beside which line integrals fall below the air, as fringes of a wave make them.

A blur, noise, and rays through voxels above zero leave the air beside an edge at the level of the air farther away, or
above it. A wave on its way to the detector takes it below. So does a filter that sharpens.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.base.arrays import F32, I64
from recon.base.noise import deviation_between_neighbours
from recon.base.views import spread

_LEVELS = 1, 4, 16  # rows averaged on either side of the comparison: a can shows one edge in all, grains one in each
MOST_VIEWS = 96  # that are looked at
_BLOCKS = 16  # groups of rows, of each level
_AVERAGED = 16  # neighbouring views that are averaged, too, as a can is alike from all sides
_AIR, _BESIDE = 6, 3  # columns of air that an edge needs, and those next to it, where the overshoot is sought
_EDGE, _OF_DEEPEST = 6.0, 0.02  # times the noise, and of the deepest line integrals, where matter begins
_FEWEST = 6  # places of edges that are needed
_AGREE, _ERRORS = 2.0, 6.0  # least standard errors: by how the places agree, by the noise of the air
SEARCH = "`recon --phase auto` searches for a filter that removes them."
LEAST_SHARE = 0.01
"""Of an edge's step; an overshoot of less is none. 227 simulated scans without fringes, looked at once after this was
set, have at most 1.9 standard errors."""


@dataclass(frozen=True)
class Overshoot:
    """Overshoot: how far line integrals beside outer edges lie below the air farther away.

    Attributes:
        share: of the edge's step.
        errors: the same in standard errors, by the noise of the air, where edges at different places agree on it.
    """

    share: float = 0.0
    errors: float = 0.0

    @property
    def certain(self) -> bool:
        return self.errors > _ERRORS and self.share > LEAST_SHARE

    @classmethod
    def of(cls, views: F32) -> Overshoot:
        """The most significant overshoot in line integrals [view, row, col]; none where no edge is beside air.

        An edge is sought in every other row and measured in the rows between, so that noise, of a ring too, does not
        choose what is measured. Edges in one column of the same rows count once.
        """
        most, some = cls(), spread(np.arange(len(views)), MOST_VIEWS)
        for n in _LEVELS:
            blocks = spread(np.arange(views.shape[1] // (2 * n)), _BLOCKS)
            if blocks.size and views.shape[2] >= 4 * _AIR:
                rows = (blocks[:, None] * 2 * n + np.arange(2 * n)).ravel()
                halves = np.stack([views[view][rows].reshape(-1, n, 2, views.shape[2]).mean(axis=1) for view in some])
                averaged = np.stack(
                    [each.mean(axis=0) for each in np.array_split(halves, -(-len(halves) // _AVERAGED))]
                )
                most = max(most, _overshoot(halves), _overshoot(averaged), key=lambda each: each.errors)
        return most

    @classmethod
    def of_counts(cls, counts: F32, dark: F32 | float, flat: F32 | float) -> Overshoot:
        """The same for counts [view, row, col], with dark and flat [row, col]; pixels unlit in the flat are air."""
        beam = flat - dark
        light = np.where(beam > 0, (counts - dark) / np.where(beam > 0, beam, 1), 1)
        return cls.of(-np.log(np.maximum(light, 1e-6)).astype(np.float32))

    def in_words(self) -> str:
        return (
            f"Beside the sample's outer edges, line integrals are {self.share:.1%} of the edge's step below the air. "
            "Blur and noise do not cause this: expect phase fringes, or views that were sharpened."
        )


def _overshoot(halves: F32) -> Overshoot:
    """Overshoot of line integrals [view, block, half of the rows, col]."""
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
    below = rays[:, 1 + _BESIDE :].mean(axis=1, dtype=np.float64)[:, None] - rays
    mean = below.mean(axis=0)
    scatter = np.square([np.bincount(at, column) for column in (below - mean).T]).sum(axis=1) * places / (places - 1)
    errors = np.sqrt(scatter[1 : 1 + _BESIDE]) / len(below) + 1e-9
    noise = np.sqrt(2 * scatter[1 + _BESIDE :].mean()) / len(below) + 1e-9  # beside the mean of three columns
    by_noise = np.where(mean[1 : 1 + _BESIDE] > _AGREE * errors, mean[1 : 1 + _BESIDE] / noise, 0)
    k = int(by_noise.argmax())
    return Overshoot(float(mean[1 + k] / -mean[0]), float(by_noise[k])) if mean[0] < 0 < by_noise[k] else Overshoot()


def _edges(sought: F32, measured: F32, kind: int) -> tuple[F32, I64]:
    """Line integrals outwards [edge, column] from the pixel inside each first edge, and the place of each [edge].

    Args:
        sought: line integrals [view, row, col] in which the edges are looked for: the steepest step where air ends.
        measured: the same of other rows, which are returned.
        kind: side and half of the rows, 0 to 3, a part of the place.
    """
    sought = sought - sought[:, :, :_AIR].mean(axis=2, keepdims=True)
    threshold = _EDGE * deviation_between_neighbours(sought[:, :, :_AIR])
    matter = sought > max(threshold, _OF_DEEPEST * float(np.percentile(sought, 98)))
    view, row = np.nonzero(~matter[:, :, : _AIR + 1].any(axis=2) & matter[:, :, : sought.shape[2] // 2].any(axis=2))
    first = matter[view, row].argmax(axis=1)
    around = np.take_along_axis(sought[view, row], first[:, None] + np.arange(-2, 3), axis=1)
    first = first - 1 + np.diff(around, axis=1).argmax(axis=1)  # the steepest step near where matter is seen
    rays = np.take_along_axis(measured[view, row], first[:, None] + np.arange(1, -_AIR - 1, -1), axis=1)
    return rays, (row * sought.shape[2] + first) * 4 + kind
