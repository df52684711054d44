"""one_projection: projects a volume for several checks at once, so that no ray is computed twice."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from recon.base.arrays import F32, I64, Mask
from recon.base.geometry import Geometry
from recon.base.slabs import part_of
from recon.base.volume import Grid, Volume
from recon.voxels.projector import Projector, volume_lines

BAND = 16
"""Largest number of detector rows that are computed together, if rows show slices."""

_AT_A_TIME = 8  # number of projections that are computed together, if rows do not show slices

Found = TypeVar("Found")


class AskedRays(NamedTuple):
    """Rays that a check compares with the projection of the volume.

    Attributes:
        views: numbers of the projections, ascending.
        rows: the detector rows.
        use: function called once with the projection [view, col, row] of the volume in these rays. At that time other
            parts may still be incomplete.
    """

    views: I64
    rows: slice
    use: Callable[[F32], None]


@dataclass(frozen=True, eq=False)
class RayCheck(Generic[Found]):
    """A check of a volume by its projections: the rays that it compares, and its result after all rays were
    compared.
    """

    parts: Sequence[AskedRays]
    result: Callable[[], Found]

    def renumbered(self, numbers: I64) -> RayCheck[Found]:
        """The same check, with its projections 0, 1, ... renumbered: `numbers` has the new numbers, ascending."""
        return replace(self, parts=[part._replace(views=numbers[part.views]) for part in self.parts])

    def alone(self, volume: Volume, geometry: Geometry) -> Found:
        """Project the volume for this check alone, and return its result."""
        project_parts(volume, geometry, self.parts)
        return self.result()


def in_bands(geometry: Geometry, grid: Grid) -> bool:
    """Whether rows show slices of this grid, so that a band of rows needs only its own slices."""
    return geometry.rows_show_slices and grid == Grid.matching(geometry)


def project_parts(
    volume: Volume,
    geometry: Geometry,
    parts: Sequence[AskedRays],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Project a volume once and give each part its projection.

    Args:
        progress: function called with the number of projections computed so far, and their total number. If rows show
            slices, each band of rows counts with its share.
    """
    if not parts:
        return
    requested = np.zeros((geometry.detector_shape[0], geometry.n_views), bool)
    for part in parts:
        requested[part.rows, part.views] = True
    rays, views, done = int(requested.sum()), int(requested.any(axis=0).sum()), 0
    waiting = [_Waiting(part) for part in parts]
    for block in _blocks(volume, geometry, requested):
        waiting = [each for each in waiting if not each.complete_with(block)]
        done += int(requested[block.rows, block.views].sum())
        progress(done * views // rays, views)


class _Block(NamedTuple):
    views: I64
    rows: slice
    lines: F32  # [view, col, row]


@dataclass(eq=False)
class _Waiting:
    """A part whose projection is not complete yet: its lines, and the number of missing rows of all projections."""

    part: AskedRays
    lines: F32 | None = None
    missing: int = field(init=False)

    def __post_init__(self) -> None:
        self.missing = len(self.part.views) * (self.part.rows.stop - self.part.rows.start)

    def complete_with(self, block: _Block) -> bool:
        """Copy the lines of the block that belong to this part. Returns True if the part is now complete; it has then
        been used.
        """
        views, rows, use = self.part
        first, end = max(rows.start, block.rows.start), min(rows.stop, block.rows.stop)
        ours = np.isin(views, block.views) if first < end else np.zeros(len(views), bool)
        if not ours.any():
            return False
        theirs = slice(None) if len(block.views) == ours.sum() else np.isin(block.views, views)
        shown = block.lines[theirs, :, first - block.rows.start : end - block.rows.start]
        self.missing -= len(shown) * (end - first)
        if self.lines is None and self.missing == 0:
            use(np.ascontiguousarray(shown))
            return True
        if self.lines is None:
            self.lines = np.empty((len(views), shown.shape[1], rows.stop - rows.start), np.float32)
        self.lines[slice(None) if ours.all() else ours, :, first - rows.start : end - rows.start] = shown
        if self.missing == 0:
            use(self.lines)
        return self.missing == 0


def _blocks(volume: Volume, geometry: Geometry, requested: Mask) -> Iterator[_Block]:
    """The projection of the rays that are asked for [row, view], in blocks in ascending order."""
    if in_bands(geometry, volume.grid):
        for rows in _equal_rows(requested):
            views = np.flatnonzero(requested[rows.start])
            _, part, grid = part_of(geometry.select(views), volume.grid, rows)
            yield _Block(views, rows, Projector(part, grid).forward_lines(volume_lines(volume.data[rows])))
        return
    wanted = np.flatnonzero(requested.any(axis=0))
    lines = volume_lines(volume.data)  # computed only once, because for a large volume it takes as long as a projection
    for first in range(0, wanted.size, _AT_A_TIME):
        views = wanted[first : first + _AT_A_TIME]
        projector = Projector(geometry.select(views), volume.grid)
        yield _Block(views, slice(0, len(requested)), projector.forward_lines(lines))


def _equal_rows(requested: Mask) -> Iterator[slice]:
    """Bands of up to 16 rows. In all rows of a band the same projections are asked for, at least one."""
    edges = np.flatnonzero((requested[1:] != requested[:-1]).any(axis=1)) + 1
    for first, end in zip([0, *edges.tolist()], [*edges.tolist(), len(requested)], strict=True):
        if requested[first].any():
            yield from (slice(row, min(row + BAND, end)) for row in range(first, end, BAND))
