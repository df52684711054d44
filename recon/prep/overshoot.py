"""Overshoot: outer edges of a sample beside which line integrals fall below the air, as fringes of a wave make them.

A blur, noise, and rays through voxels above zero leave the air beside an edge at the level of the air farther away, or
above it. A wave on its way to the detector, and a filter that sharpens, take it below.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from recon.base.arrays import F32, I64, median_deviation
from recon.base.views import spread

_LEVELS = 1, 4, 16  # rows averaged on either side of the comparison: a can shows one edge in all, grains one in each
_VIEWS, _BLOCKS = 90, 16  # looked at, of each level
_AIR, _NEAR = 7, 4  # columns of air that an edge needs, and those next to it, where the overshoot is sought
_EDGE, _OF_DEEPEST = 6.0, 0.02  # times the noise, and of the deepest line integrals, where an edge begins
_RISE = 6  # columns from there to its steepest step, at most
_FEWEST = 6  # edges at different places
_SIGMAS, _SHARE = 6.0, 0.01


class _Edges(NamedTuple):
    """Outer edges: line integrals outwards [edge, column], those inside [edge], and where they are [edge]."""

    outside: F32
    inside: F32
    place: I64


@dataclass(frozen=True)
class Overshoot:
    """By how much line integrals beside outer edges lie below the air farther away.

    Attributes:
        share: of the edge's step.
        sigmas: the same in standard errors, by how edges at different places disagree.
    """

    share: float = 0.0
    sigmas: float = 0.0

    @property
    def certain(self) -> bool:
        return self.sigmas > _SIGMAS and self.share > _SHARE

    @classmethod
    def of(cls, views: F32) -> Overshoot:
        """The most significant overshoot in line integrals [view, row, col]; none where no edge is beside air.

        An edge is sought in every other row and measured in the rows between, so that noise, of a ring too, does not
        choose what is measured. Edges in one column of the same rows count once.
        """
        most = cls()
        for n in _LEVELS:
            if blocks := views.shape[1] // (2 * n):
                rows = (spread(np.arange(blocks), _BLOCKS)[:, None] * 2 * n + np.arange(2 * n)).ravel()
                some = spread(np.arange(len(views)), _VIEWS)
                halves = np.stack([views[view][rows].reshape(-1, n, 2, views.shape[2]).mean(axis=1) for view in some])
                most = max(most, _overshoot(halves), key=lambda each: each.sigmas)
        return most


def _overshoot(halves: F32) -> Overshoot:
    """Of line integrals [view, block, half of the rows, col]."""
    edges = [
        _edges(halves[:, :, half, ::way], halves[:, :, 1 - half, ::way], 2 * half + (way > 0))
        for half in (0, 1)
        for way in (1, -1)
    ]
    outside, inside, place = (np.concatenate(parts) for parts in zip(*edges, strict=True))
    at = np.unique(place, return_inverse=True)[1]
    places = int(at.max(initial=-1)) + 1
    if places < _FEWEST:
        return Overshoot()
    air = outside[:, _NEAR:].mean(axis=1, dtype=np.float64)
    below = air[:, None] - outside[:, :_NEAR]
    mean, step = below.mean(axis=0), float((inside - air).mean())
    sums = np.stack([np.bincount(at, column) for column in (below - mean).T])
    errors = np.sqrt(np.square(sums).sum(axis=1) * places / (places - 1)) / len(below)
    sigmas = mean / np.maximum(errors, np.finfo(np.float32).eps * step)
    k = int(sigmas.argmax())
    return Overshoot(float(mean[k] / step), float(sigmas[k])) if sigmas[k] > 0 and step > 0 else Overshoot()


def _edges(sought: F32, measured: F32, kind: int) -> _Edges:
    """First edges from the first column on: from where the air ends, up to the first of the steepest steps.

    Args:
        sought, measured: line integrals [view, row, col], by which edges are found, and which are returned.
        kind: is part of the place.
    """
    cols = sought.shape[2]
    if cols < 2 * (_AIR + _RISE):
        return _Edges(np.empty((0, _AIR), np.float32), np.empty(0, np.float32), np.empty(0, np.int64))
    sought = sought - sought[:, :, : _AIR - 1].mean(axis=2, keepdims=True)
    noise = median_deviation(np.diff(sought[:, :, :_AIR], axis=2)) / np.sqrt(2)
    matter = sought > max(_EDGE * noise, _OF_DEEPEST * float(np.percentile(sought, 98)))
    first = matter.argmax(axis=2)
    view, row = np.nonzero((first >= _AIR) & (first < cols // 2))
    first = first[view, row]
    values = np.take_along_axis(sought[view, row], first[:, None] + np.arange(-1, _RISE), axis=1)
    falls = np.diff(values, 2, axis=1) < 0
    first = first + np.where(falls.any(axis=1), falls.argmax(axis=1), 0)
    rays = np.take_along_axis(measured[view, row], first[:, None] + np.arange(1, -_AIR - 1, -1), axis=1)
    return _Edges(rays[:, 2:], rays[:, 0], (row * cols + first) * 4 + kind)
