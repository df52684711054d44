"""Spots (zingers): finds and fills pixels that a stray gamma or X-ray photon hit in a single projection."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, I64, MEDIAN, Mask
from recon.base.choices import SPOT_ERRORS
from recon.base.jit import njit
from recon.base.masks import Image, fill, plan_fill
from recon.prep.unmeasured import DARK, NO_RUNS

# smallest assumed noise of √intensity, as a fraction of √intensity of the open beam. It is 1 % of the intensity, for
# the grain of the optics
_LEAST = 0.005
_WIDEST = 3  # pixels of a spot along rows and columns
_AROUND = 3  # pixels on each side of a spot in which the normal difference of the projections is measured
# number of pixels (approximate; smallest) from which the noise of a projection, and a change of its intensity, are
# measured
_SAMPLE, _FEWEST = 600, 30
# limit of √intensity; a darker projection cannot show whether a gap is about to open in the sample
_OPAQUE = DARK**0.5
_MEDIAN = MEDIAN * 2**0.5  # median of |x - y| for normal variables of standard deviation 1


@dataclass(frozen=True, eq=False)
class Transmission:
    """Projections before their spots are filled: divided by the flat, or given as line integrals.

    Attributes:
        data: float32 [view, row, col], finite; `line_integrals` reuses its memory.
        view_ids: int64 [view].
        repaired: int64 [view], number of pixels that were not finite or part of a spot, and were filled from their
            neighbours.
        air: float32 [view], transmission of the air by which each projection was divided. 1: it was not divided yet.
        beam: float32 [view, row, col], number of photons without the sample; None: photons are not counted.
        unmeasured: int64 [run, 4], pixels without data, filled from their neighbours, see `runs_of`.
        unseen: bool [row, col], pixels that are not finite in any projection of this batch; None: not determined.
    """

    data: F32
    view_ids: NDArray[np.int64]
    repaired: NDArray[np.int64]
    air: F32
    beam: F32 | None = None
    unmeasured: I64 = field(default_factory=NO_RUNS.copy)
    unseen: Mask | None = None

    def __getitem__(self, part: slice | NDArray[np.intp] | list[int]) -> Transmission:
        """A part of the projections."""
        ids, beam = self.view_ids[part], None if self.beam is None else self.beam[part]
        runs = self.unmeasured[np.isin(self.unmeasured[:, 0], ids)]
        return Transmission(self.data[part], ids, self.repaired[part], self.air[part], beam, runs)

    def and_then(self, later: Transmission) -> Transmission:
        """These projections, followed by later ones."""
        pairs = zip(vars(self).values(), vars(later).values(), strict=True)
        joined: list[Any] = [None if first is None else np.concatenate((first, then)) for first, then in pairs]
        return Transmission(*joined)


@dataclass(frozen=True, eq=False)
class SpotFilter:
    """Fills the spots of projections by comparing neighbours in angle or time. The projections may come in batches of
    any size.

    The newest projection waits for the next one. The result is bit-identical for any split into batches.

    Attributes:
        threshold: see `spots`; inf: no spot is filled.
        root: function that returns the √transmission of a projection, in which photon noise is the same everywhere.
        before: the last projection whose spots were filled, as √transmission; None: there is none.
        waiting: the newest projection, which waits for the next one; None: no projection waits.
        n_unfilled: number of pixels of spots that were too large to be filled, in all projections so far.
    """

    threshold: float
    root: Callable[[F32], F32]
    before: Image | None = None
    waiting: Transmission | None = None
    n_unfilled: int = 0

    def feed(
        self,
        views: Transmission | None,
        last: bool = True,
        progress: Callable[[int], None] = lambda done: None,
        order: NDArray[np.intp] | None = None,
    ) -> tuple[Transmission, SpotFilter]:
        """The waiting projection and the given ones, with their spots filled in place; and the filter for the
        projections that follow.

        Args:
            views: the next projections; None: the waiting projection was the last one.
            last: True if no projection comes after these. False: the newest projection waits. progress: function called
                with the number of projections done, after each one.
            order: [view], an order in which neighbours are adjacent. With an order, all projections must be given at
                once, and none waits. None: the neighbours of a projection are the projections before and after it.
        """
        if self.waiting is not None:
            views = self.waiting[[0]] if views is None else self.waiting.and_then(views)
        assert views is not None
        total, before, n_unfilled = len(views.data), self.before, self.n_unfilled
        n, order = total if last else max(total - 1, 0), np.arange(total) if order is None else order
        current = self.root(views.data[order[0]]) if n else None
        for done, view in enumerate(order[:n], 1):
            after = self.root(views.data[order[done]]) if done < total else None
            if current is not None and np.isfinite(self.threshold):
                mask, n_large = spots(current, before, after, self.threshold)
                n_unfilled += n_large
                if mask.any():
                    views.repaired[view] += mask.sum()
                    fill(views.data[view], plan_fill(mask))
                    current = self.root(views.data[view])
            before, current = current, after
            progress(done)
        waiting = views[np.arange(n, total)] if n < total else None
        return views[:n], replace(self, before=before, waiting=waiting, n_unfilled=n_unfilled)


def without_spots(frames: Iterable[NDArray[Any]], intensity: float) -> Iterator[tuple[NDArray[Any], int]]:
    """Darks or flats [row, col] without their spots, and the number of filled pixels in each frame.

    A spot is filled with the mean of the frames before and after. If there is only one frame, it is not changed.

    Args:
        intensity: counts in the open beam.
    """
    before: NDArray[Any] | None = None
    remaining = iter(frames)
    current = next(remaining, None)
    while current is not None:
        after = next(remaining, None)
        n, neighbours = 0, [each for each in (before, after) if each is not None]
        if neighbours:
            first, second = (None if each is None else _root_intensity(each, intensity) for each in (before, after))
            mask, _ = spots(_root_intensity(current, intensity), first, second, SPOT_ERRORS, still=True)
            if n := int(np.count_nonzero(mask)):
                current = np.where(mask, np.mean(neighbours, axis=0), current)
        yield current, n
        before, current = current, after


def _root_intensity(counts: NDArray[Any], intensity: float) -> Image:
    return np.sqrt(np.maximum(counts, 0) / max(intensity, 1e-30), dtype=np.float32)


def spots(
    view: Image, before: Image | None, after: Image | None, threshold: float, *, still: bool = False
) -> tuple[Mask, int]:
    """Mask [row, col] of spots, which are brighter than the neighbouring projections and than their surroundings.

    The second result is the number of pixels in spots that are too large.

    All images are √transmission, in which photon noise is uniform. A spot is at most three pixels wide along its row
    and its column. The previous projection, whose spots are filled, must have nothing as bright within one pixel. These
    rules distinguish spots from edges of the sample, which are longer, and from gaps in it, which move from projection
    to projection. A gap between opaque grains may open in a single projection. So if a neighbouring projection is
    opaque there, a spot must be brighter than the open beam and than both neighbours. Such a bright pixel may be part
    of a line, and the next projection may have a spot there, too.

    Args:
        before, after: the projections before and after; None: there is no such projection. If most of the present
            projection is brighter than both, its intensity has changed, and both are scaled to its brightness.
        threshold: a spot is brighter by more than this many standard deviations of the noise. The noise is the largest
            of three values: the noise between the pixels of this projection, the difference of both neighbours around
            the pixel (because the sample turns), and 1 % of the intensity. A normal variable exceeds 8 standard
            deviations once in 10¹⁵ pixels.
        still: True if there is no moving sample, as in darks and flats.
    """
    mask, neighbours = np.zeros(view.shape, np.bool_), [image for image in (before, after) if image is not None]
    first, *others = neighbours or [np.zeros_like(view)] * 2
    second, against = others[0] if others else first, others[0] if others else view
    noise, change = _noise_and_change(view, first, second)
    limit = threshold * max(noise / _MEDIAN, _LEAST)
    if change > 1 + _LEAST:
        first, second = first * np.float32(change), second * np.float32(change)
        against = second if others else view
    beam = 1.0 if neighbours and not still else np.inf
    return mask, _mark(view, first, second, against, limit, beam, threshold / _MEDIAN, mask)


@njit(nogil=True, cache=True)
def _noise_and_change(view, before, after):  # type: ignore[no-untyped-def]
    """Two medians over some pixels with beam: the difference from the next pixel, and the intensity divided by that of
    a neighbouring projection.

    The neighbouring projection is the brighter one of `before` and `after`. The second median is 0 if no pixel has
    beam, or if the sum of the intensity is not larger than in the neighbour."""
    rows, cols = view.shape
    step = max(1, rows * cols // _SAMPLE)
    differences, ratios = np.empty((2, rows * cols // step + 1), np.float32)
    n = n_exposed = 0
    excess = 0.0
    for pixel in range(0, rows * cols, step):
        r, c = pixel // cols, pixel % cols
        if c + 1 < cols and view[r, c] > _OPAQUE:
            differences[n] = abs(view[r, c + 1] - view[r, c])
            n += 1
        brighter_neighbour = max(before[r, c], after[r, c])
        if brighter_neighbour > _OPAQUE:
            ratios[n_exposed] = view[r, c] / brighter_neighbour
            excess += view[r, c] - brighter_neighbour
            n_exposed += 1
    noise = np.median(differences[:n]) if n > _FEWEST else 0.0
    return noise, np.median(ratios[:n_exposed]) if excess > 0 else 0.0


@njit(nogil=True, cache=True)
def _mark(  # type: ignore[no-untyped-def]
    view, before, after, against, limit, beam, errors, mask
):
    """Mark the spots for `spots`, and count the pixels of spots that are too large.

    Around a spot, `against` is compared with the projection before. `beam` is √intensity of the open beam, or inf if
    there are no gaps in a sample. `errors` is the threshold divided by the median difference of two normal variables.
    """
    rows, cols = view.shape
    differences = np.empty((2 * _AROUND + 1) ** 2, np.float32)
    n_unfilled, brightest = 0, beam
    for r in range(rows):
        for c in range(cols):
            brightest = max(brightest, min(before[r, c], after[r, c]))
    for r in range(rows):
        for c in range(cols):
            intensity = view[r, c]
            stray = intensity > brightest + limit
            if intensity <= before[r, c] + limit or (not stray and intensity <= after[r, c] + limit):
                continue
            along, down = -np.inf, -np.inf  # intensity that the brightest part of a line must exceed to be a spot
            for first in range(-_WIDEST, 1):
                if c + first >= 0 and c + first + _WIDEST < cols:
                    along = max(along, view[r, c + first : c + first + _WIDEST + 1].min())
                if r + first >= 0 and r + first + _WIDEST < rows:
                    down = max(down, view[r + first : r + first + _WIDEST + 1, c].min())
            around = min(along, down) if stray and down > -np.inf else max(along, down)
            if not stray:
                if beam < np.inf and min(before[r, c], after[r, c]) < _OPAQUE:
                    continue
                near = before[max(0, r - 1) : r + 2, max(0, c - 1) : c + 2].max()
                around = max(around, near, after[r, c])
            height = intensity - max(around, before[r, c])
            if height > limit:
                n = 0
                for i in range(max(0, r - _AROUND), min(rows, r + _AROUND + 1)):
                    for j in range(max(0, c - _AROUND), min(cols, c + _AROUND + 1)):
                        differences[n] = abs(before[i, j] - against[i, j])
                        n += 1
                mask[r, c] = height > errors * np.median(differences[:n])
            n_unfilled += stray and height <= limit
    return n_unfilled
