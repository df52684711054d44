"""Rays of a view through the box of a field: where they run, which ones a step takes, and samples along them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64, Mask
from recon.base.geometry import Geometry
from recon.base.volume import Grid

Places = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Rays:
    """Parts of rays within a box whose widest edge is one.

    Attributes:
        start: float32 [n, 3], (x, y, z) where the ray enters.
        path: float32 [n, 3] to where it leaves; zero for a ray that misses the box.
    """

    start: F32
    path: F32

    def samples(self, places: F32) -> F32:
        """Points [n, m, 3] at shares `places` [n, m] or [m] of the paths, within the box."""
        return np.clip(self.start[:, None] + places[..., None] * self.path[:, None], 0, 1)

    @property
    def lengths(self) -> F32:
        return np.linalg.norm(self.path, axis=1)


def rays_of(geometry: Geometry, view: int, pixels: Places, grid: Grid) -> Rays:
    """Rays to pixels of a view, counted along its rows, through the box of `grid`."""
    rows, cols = np.divmod(pixels, geometry.detector_shape[1])
    along_col, along_row, beam = geometry.axes(view)
    col, row = geometry.origin(view)
    on_detector = geometry.pixel_pitch * (np.outer(cols - col, along_col) + np.outer(rows - row, along_row))
    if geometry.is_cone:
        source = geometry.centres[view] - geometry.sod * beam
        start, run = np.tile(source, (pixels.size, 1)), on_detector + geometry.sdd * beam
    else:
        start, run = on_detector, np.tile(beam, (pixels.size, 1))
    if geometry.skew:
        start, run = (_turned(vectors, rows * geometry.skew) for vectors in (start, run))
    low, high = grid.edges
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack(((low - start) / run, (high - start) / run))
    # A ray along a side of the box lies between its ends, or misses them.
    flat = np.broadcast_to(run == 0, ends.shape)
    inside = np.broadcast_to((start >= low) & (start <= high), ends.shape)
    ends = np.where(flat, np.where(inside, np.array([-np.inf, np.inf])[:, None, None], np.inf), ends)
    enter, leave = ends.min(0).max(1), ends.max(0).min(1)
    missed = ~(leave > enter)
    enter, leave = np.where(missed, 0, enter)[:, None], np.where(missed, 0, leave)[:, None]
    edge = (high - low).max()
    return Rays(*((part / edge).astype(np.float32) for part in (start + enter * run - low, (leave - enter) * run)))


def _turned(vectors: F64, angles: F64) -> F64:
    """Vectors (x, y, z), each turned about z by its angle."""
    c, s, (x, y, z) = np.cos(angles), np.sin(angles), vectors.T
    return np.stack((c * x - s * y, s * x + c * y, z), 1)


def drawn(rng: np.random.Generator, candidates: Mask, count: int, windows: int, side: int) -> Places:
    """Pixels of a view for one step: `windows` squares of `side` pixels, and `count` candidates outside of them.

    Args:
        candidates: [row, col]; windows fall anywhere. Without windows at most so many pixels as there are candidates.
    """
    (rows, cols), places = candidates.shape, []
    free = candidates
    if windows:
        side = min(side, rows, cols)
        top, left = rng.integers(0, rows - side + 1, windows), rng.integers(0, cols - side + 1, windows)
        within = np.arange(side)
        at = (top[:, None, None] + within[:, None]) * cols + left[:, None, None] + within
        places.append(at.ravel())
        free = candidates.copy()
        free.reshape(-1)[at.ravel()] = False
    left_over = np.flatnonzero(free)
    if left_over.size > count:
        left_over = left_over[rng.integers(0, left_over.size, count)]
    return np.concatenate((*places, left_over))
