"""A projection as the checks use it (`CellView`): line integrals on a coarse grid of square cells.

It is computed once per frame, for all checks. The grid has 128 to 255 columns, which determines the size of a cell in
pixels. Therefore a check needs no more time for 2304 x 4096 pixels than for 128 x 512 pixels, and a limit in cells is
the same fraction of the field of view for large and small frames.

Spots (zingers) are bright pixels of a single frame that a stray X-ray photon or a muon has hit. The largest pixel of a
preview block counts as a spot under two conditions: it is brighter than the means of all blocks around it by more than
noise explains; and it is brighter than the same place in the previous frame. (Hot pixels and bright gaps in the sample
stay from frame to frame.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beamline.core.flag import PixelBox
from beamline.monitor.digest import FrameDigest, block_side
from drivers.base.frame import Frame, FrameKind
from recon.base.arrays import median_deviation

COLS = 128  # least number of columns of cells, if the preview has as many blocks
DARKEST = 1e-3  # transmission below which the logarithm would show only noise
UNLIT = 0.05  # fraction of the bright part of the flats; a cell with less intensity counts as a cell without beam
HOT = 0.1  # a cell is not used if its dark is higher than others by this fraction of the bright part of the flats
EDGE = 2  # cells at each edge that show whether the sample ends within the field of view
SEEN = 0.02  # least transmission of a place at which the beam is visible
PLACES = (4, 16)  # parts of the field of view, vertical and horizontal; the brightest one counts as air
# line integral at the brightest place; if it is larger, there is no air, or the beam became weaker earlier
COVERED = 0.1
AIR = 0.05  # line integral up to which the edges are air, so that one projection is enough to measure a beam loss
DRIFT_STEP = 0.02  # log intensity by which the beam may drift between two projections that show air
# allowed difference between the edges and the brightest place: as a fraction of the beam loss; in units of the noise
EVEN, EVEN_NOISE = 0.2, 0.01
BRIGHT = 90.0  # percentile of the cells of the flats that stands for the bright part

CellValues = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class CellGrid:
    """The cells of a frame, and the intensity of each cell without a sample."""

    cell: int  # side of a cell in pixels
    blocks: int  # side of a cell in preview blocks
    dark: CellValues  # counts [row, col] of the cells without beam; 0 if there was no dark yet
    full: CellValues  # counts above the dark with beam and without sample, at the exposure of the flats
    exposed: CellValues  # float32 [row, col], 1 if a cell gets enough beam, otherwise 0
    flats: bool  # False if there are no flats: `full` is then 1, and line integrals are relative
    # row_dark, col_dark: mean dark counts of each preview row and column
    row_dark: CellValues
    col_dark: CellValues
    # left, right: first and last column of cells in which most cells get beam
    left: int
    right: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.full.shape

    def region(self, row: float, col: float, height: float, width: float) -> PixelBox:
        """Box in pixels that contains the cells around a position, within the grid."""
        rows, cols = self.shape
        top, left = max(0, math.floor(row + 0.5 - height / 2)), max(0, math.floor(col + 0.5 - width / 2))
        below, right = min(rows, math.ceil(row + 0.5 + height / 2)), min(cols, math.ceil(col + 0.5 + width / 2))
        return top * self.cell, below * self.cell, left * self.cell, right * self.cell


@dataclass(frozen=True, eq=False)
class CellView:
    """A projection on the grid."""

    index: int  # row in the file
    angle: float  # radians
    # depth: float32 [row, col], line integrals; in a cell without beam the mean of its left and right neighbour, or 0
    # if they have no beam either
    depth: CellValues
    weight: CellValues  # float32 [row, col], photons relative to the open beam: exp(-depth), 0 in cells without beam
    # rows, cols: float32 [preview row], [preview col], mean counts above the dark
    rows: CellValues
    cols: CellValues
    edges: tuple[float, float]  # line integrals at the left and right edge of the cells with beam, medians over rows
    brighter: float = 0.0  # change of the logarithm of the intensity since the previous projection; 0 if not known


def grid_of(
    preview: tuple[int, int], block: int, dark: NDArray[np.float32] | None, flat: NDArray[np.float32] | None
) -> CellGrid:
    """The grid of frames whose preview has this shape, with blocks of `block` pixels a side."""
    blocks = max(1, preview[1] // COLS)
    blocks = min(blocks, preview[0])
    dark = np.zeros(preview, np.float32) if dark is None else dark
    low, rows, cols = _binned(dark, blocks)
    if flat is None:
        full = np.ones_like(low)
        exposed = full
    else:
        full = _binned(flat, blocks)[0] - low
        bright = float(np.percentile(full, BRIGHT))
        hot = low - np.median(low) > HOT * bright
        exposed = ((full > UNLIT * max(bright, 0.0)) & ~hot).astype(np.float32)
        full = np.where(exposed > 0, full, np.float32(1))
    wide = np.flatnonzero(exposed.mean(axis=0) > 0.5)
    left, right = (int(wide[0]), int(wide[-1])) if wide.size else (0, exposed.shape[1] - 1)
    return CellGrid(blocks * block, blocks, low, full, exposed, flat is not None, rows, cols, left, right)


def view_of(preview: NDArray[np.float32], grid: CellGrid, index: int, angle: float, exposure_ratio: float) -> CellView:
    """A projection on the grid. `exposure_ratio` is its exposure divided by that of the flats."""
    counts, rows, cols = _binned(preview, grid.blocks)
    darkest = np.float32(DARKEST * (1 if grid.flats else 1e3))
    through = np.maximum((counts - grid.dark) / grid.full * np.float32(1.0 / exposure_ratio), darkest)
    exposed = (grid.exposed > 0) & ~np.isnan(through)
    weight = np.where(exposed, np.minimum(through, 1), 0)
    depth = np.where(exposed, -np.log(through), 0)
    gap = ~exposed[:, 1:-1] & exposed[:, :-2] & exposed[:, 2:]
    depth[:, 1:-1][gap] = 0.5 * (depth[:, :-2] + depth[:, 2:])[gap]
    left, right = depth[:, grid.left : grid.left + EDGE], depth[:, grid.right + 1 - EDGE : grid.right + 1]
    edges = float(np.median(left)), float(np.median(right))
    return CellView(index, angle, depth, weight, rows - grid.row_dark, cols - grid.col_dark, edges)


def remaining_intensity(view: CellView, last: CellView | None, grid: CellGrid) -> float:
    """Upper bound of the intensity in nine tenths of the cells, relative to the last good projection (before the first
    one: relative to the flats).

    A rotating sample makes some cells darker and others brighter; only a loss of beam makes all of them darker.
    Opaque cells do not count.
    """
    if last is None:
        if not grid.flats:
            return 1.0
        through = view.weight[grid.exposed > 0]
        return (
            1.0
            if through.size == 0 or np.percentile(through[::3], BRIGHT) >= UNLIT
            else float(np.percentile(through, BRIGHT))
        )
    measured = last.weight > SEEN
    if not measured.any():
        return 1.0
    return math.exp(float(np.percentile((last.depth - view.depth)[measured][::3], BRIGHT)))


def brightest_place(view: CellView, grid: CellGrid) -> float:
    """Mean line integral of the brightest part of the field of view with beam: 0 in air."""
    depth, exposed = view.depth[:, grid.left : grid.right + 1], grid.exposed[:, grid.left : grid.right + 1]
    down, across = (min(parts, n) for parts, n in zip(PLACES, depth.shape, strict=True))
    sums, cells = (sums_of_places(part, down, across) for part in (depth, exposed))
    means = sums[cells > 0] / cells[cells > 0]
    return float(means.min()) if means.size else 0.0


def dimmer_than_flats(view: CellView, grid: CellGrid, before: float) -> float:
    """Logarithm of the loss of beam intensity since the flats, measured in air; NaN if no air was seen yet.

    If the beam becomes weaker, both edges and the brightest part become darker by the same factor, and hardly darker
    than in the previous projection. If a sample enters the beam, this is not so.

    Args:
        before: the result for the previous projection.
    """
    if not grid.flats:
        return math.nan
    now = brightest_place(view, grid)
    places = (*view.edges, now)
    even = max(places) - min(places) <= EVEN * abs(now) + EVEN_NOISE
    if even and (abs(now) <= AIR or abs(now - before) <= DRIFT_STEP or 0 < now < before):
        return now
    return min(before, max(now, 0.0)) if before > 0 else before


def sums_of_places(image: CellValues, down: int, across: int) -> CellValues:
    """Sums over a grid of `down` x `across` places."""
    rows, cols = (np.arange(parts) * n // parts for parts, n in zip((down, across), image.shape, strict=True))
    return np.add.reduceat(np.add.reduceat(image, rows, axis=0), cols, axis=1)


def cell_noise(depth: CellValues, weight: CellValues) -> float:
    """Standard deviation of a cell of weight 1, from third differences along the columns, which edges of the sample
    change little."""
    third = np.diff(depth, 3, axis=1) * np.sqrt(weight[:, 1:-2])
    return median_deviation(third) / math.sqrt(20.0)


def _binned(preview: NDArray[np.float32], blocks: int) -> tuple[CellValues, CellValues, CellValues]:
    """Means of the cells, and of each preview row and column."""
    rows, cols = (n // blocks for n in preview.shape)
    # This is faster than sums over a short axis.
    lines = reduce(np.add, (preview[k : rows * blocks : blocks] for k in range(blocks)))
    cells = reduce(np.add, (lines[:, k : cols * blocks : blocks] for k in range(blocks))) / np.float32(blocks * blocks)
    return cells, preview.mean(axis=1), preview.mean(axis=0)


# factor on the usual excess of a block's largest pixel over its mean: 8 to 10 standard deviations of a pixel
NOISES = 4.0
RELATIVE = 0.25  # smallest excess of a spot, as a fraction of the intensity around it; weaker spots are hardly visible
SAMPLES = 4096  # number of blocks from which the usual excess is computed
MOST = 4096  # largest number of spots whose positions are kept


class Spots(NamedTuple):
    """The spots of a frame: their number, and the number of saturated pixels in them."""

    n: int = 0
    saturated: int = 0


NO_SPOTS = Spots()


def spots_of(
    frame: Frame, digest: FrameDigest, before: FrameDigest | None, dark: NDArray[np.float32] | None, saturation: float
) -> Spots:
    """The spots of a projection or a flat, found with the previous frame and the preview of the darks."""
    if before is None or frame.kind is FrameKind.DARK or digest.preview.shape != before.preview.shape:
        return NO_SPOTS
    stride = max(1, digest.preview.size // SAMPLES)
    base = 0.0 if dark is None else float(np.median(dark.ravel()[::stride]))
    mean, peak = digest.preview.ravel()[::stride], digest.peaks.ravel()[::stride]
    usual = float(np.median((peak - mean) / np.sqrt(np.maximum(mean - base, 1))))
    if not usual > 0:  # blocks of one pixel, or frames without noise
        return NO_SPOTS
    places = _isolated(digest, before.peaks, base, NOISES * usual)
    size = block_side(frame.counts.shape, digest.preview.shape)
    saturated = 0
    for row, col in places[:MOST]:
        if digest.peaks[row, col] >= saturation:
            block = frame.counts[row * size : (row + 1) * size, col * size : (col + 1) * size]
            saturated += int((block >= saturation).sum())
    return Spots(len(places), saturated)


def _isolated(digest: FrameDigest, before: NDArray[np.float32], dark: float, noises: float) -> NDArray[np.intp]:
    """Rows and columns [block, 2] of the blocks with a spot."""
    rise = digest.peaks - digest.preview
    far = np.flatnonzero(rise * rise > noises**2 * np.maximum(digest.preview - dark, 1))
    rows, cols = np.divmod(far, rise.shape[1])
    (neighbours, was), peaks = (
        (_around(image, rows, cols) for image in (digest.preview, before)),
        digest.peaks[rows, cols],
    )
    brightest_neighbour = np.delete(neighbours, 4, axis=1).max(axis=1)  # the block itself is left out
    intensity = np.maximum(brightest_neighbour - dark, 1)
    bright = peaks - brightest_neighbour > np.maximum(noises * np.sqrt(intensity), RELATIVE * intensity)
    new = was.max(axis=1) - brightest_neighbour < 0.5 * (peaks - brightest_neighbour)
    return np.stack([rows, cols], axis=1)[bright & new]


def _around(image: NDArray[np.float32], rows: NDArray[np.intp], cols: NDArray[np.intp]) -> NDArray[np.float32]:
    """Values [place, 9] of the 3 x 3 blocks about some places; 0 beyond the edges."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(image, 1), (3, 3))
    return windows[rows, cols].reshape(-1, 9)
