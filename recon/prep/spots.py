"""Spots: pixels that a stray gamma or X-ray lit in a single view, found beside the neighbouring views, and filled."""

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

_LEAST = 0.005  # least noise of √light, of that of the open beam: 1 % of its light, as grain of screen and optics
_WIDEST = 3  # pixels of a spot along rows and columns
_AROUND = 3  # pixels on each side of a spot that show how much the views differ there
_SAMPLE, _FEWEST = 600, 30  # pixels, about, that show the noise of a view, and whether its light has changed
_OPAQUE = DARK**0.5  # √light, below which matter shows nothing of a gap that opens in it
_MEDIAN = MEDIAN * 2**0.5  # of |x - y|, for normal variables of standard deviation 1


@dataclass(frozen=True, eq=False)
class Transmission:
    """Views divided by the flat, or line integrals as they were given, before their spots are filled.

    Attributes:
        data: float32 [view, row, col], finite; `line_integrals` takes it over.
        view_ids: int64 [view].
        repaired: int64 [view], pixels that were not finite, or a spot; filled from their neighbours.
        air: float32 [view], transmission of the air by which each view was divided; 1 before.
        beam: float32 [view, row, col], photons without the sample; None: photons are not counted.
        unmeasured: int64 [run, 4], pixels that measured nothing, filled from their neighbours, see `runs_of`.
        unseen: bool [row, col], pixels that are finite in none of the views of this batch; None: not looked for.
    """

    data: F32
    view_ids: NDArray[np.int64]
    repaired: NDArray[np.int64]
    air: F32
    beam: F32 | None = None
    unmeasured: I64 = field(default_factory=NO_RUNS.copy)
    unseen: Mask | None = None

    def __getitem__(self, part: slice | NDArray[np.intp] | list[int]) -> Transmission:
        """Some of the views."""
        ids, beam = self.view_ids[part], None if self.beam is None else self.beam[part]
        runs = self.unmeasured[np.isin(self.unmeasured[:, 0], ids)]
        return Transmission(self.data[part], ids, self.repaired[part], self.air[part], beam, runs)

    def and_then(self, later: Transmission) -> Transmission:
        """These views and later ones."""
        pairs = zip(vars(self).values(), vars(later).values(), strict=True)
        joined: list[Any] = [None if first is None else np.concatenate((first, then)) for first, then in pairs]
        return Transmission(*joined)


@dataclass(frozen=True, eq=False)
class SpotFilter:
    """Fills spots of views that come in batches of any size, each view between its neighbours in angle or time.

    The newest view waits for the next one. The result is the same to the bit for any split into batches.

    Attributes:
        threshold: see `spots`; inf fills none.
        root: √transmission of the pixels of a view, where the noise of photons is everywhere the same.
        before: the last view that was freed of spots, as `root` reads it; None: there is none.
        waiting: the newest view, which waits for the one after it; None: none waits.
        left: pixels of spots that were too large to be filled, in all views so far.
    """

    threshold: float
    root: Callable[[F32], F32]
    before: Image | None = None
    waiting: Transmission | None = None
    left: int = 0

    def feed(
        self,
        views: Transmission | None,
        last: bool = True,
        progress: Callable[[int], None] = lambda done: None,
        order: NDArray[np.intp] | None = None,
    ) -> tuple[Transmission, SpotFilter]:
        """The waiting view and these, their spots filled in place; and the filter of the views that follow.

        Args:
            views: the next ones; None: there are none after the waiting one.
            last: no view comes after these; else the newest then waits.
            progress: how many views are done, after each.
            order: [view], where each view has its neighbours, beside it; all views are there, and none waits. None:
                their neighbours are those before and after.
        """
        if self.waiting is not None:
            views = self.waiting[[0]] if views is None else self.waiting.and_then(views)
        assert views is not None
        total, before, left = len(views.data), self.before, self.left
        n, order = total if last else max(total - 1, 0), np.arange(total) if order is None else order
        here = self.root(views.data[order[0]]) if n else None
        for done, view in enumerate(order[:n], 1):
            after = self.root(views.data[order[done]]) if done < total else None
            if here is not None and np.isfinite(self.threshold):
                found, large = spots(here, before, after, self.threshold)
                left += large
                if found.any():
                    views.repaired[view] += found.sum()
                    fill(views.data[view], plan_fill(found))
                    here = self.root(views.data[view])
            before, here = here, after
            progress(done)
        waiting = views[np.arange(n, total)] if n < total else None
        return views[:n], replace(self, before=before, waiting=waiting, left=left)


def without_spots(frames: Iterable[NDArray[Any]], light: float) -> Iterator[tuple[NDArray[Any], int]]:
    """Darks or flats [row, col] without their spots, each filled by the mean of the frames beside it, and the number of
    pixels filled in each. A single frame stays as it is.

    Args:
        light: counts of the open beam.
    """
    before: NDArray[Any] | None = None
    left = iter(frames)
    here = next(left, None)
    while here is not None:
        after = next(left, None)
        n, beside = 0, [each for each in (before, after) if each is not None]
        if beside:
            first, second = (None if each is None else _root_of(each, light) for each in (before, after))
            found, _ = spots(_root_of(here, light), first, second, SPOT_ERRORS, still=True)
            if n := int(np.count_nonzero(found)):
                here = np.where(found, np.mean(beside, axis=0), here)
        yield here, n
        before, here = here, after


def _root_of(counts: NDArray[Any], light: float) -> Image:
    return np.sqrt(np.maximum(counts, 0) / max(light, 1e-30), dtype=np.float32)


def spots(
    view: Image, before: Image | None, after: Image | None, threshold: float, *, still: bool = False
) -> tuple[Mask, int]:
    """bool [row, col], pixels that a stray photon lit: brighter than the neighbouring views, and than what is around;
    and how many belong to spots that are too large.

    All images are √transmission, where photon noise is uniform. A spot is at most three pixels wide along its row and
    its column, and the view before, which is free of spots, has none within a pixel: edges of a sample are longer, and
    its gaps move on. A gap between opaque grains may open in a single view. So where a neighbouring view is opaque, a
    spot is light of no sample: brighter than the open beam, and than all that both neighbours have. Such light may be
    part of a line, and the next view may have a spot there, too.

    Args:
        before, after: the views beside it in angle; None: there is none. They are made as bright as the view where most
            of it is brighter than both: its light has changed.
        threshold: standard deviations of the noise by which a spot is brighter. The noise is the largest of three: that
            between the pixels of this view, that between both neighbours around the pixel (the sample turns), and 1 %
            of the light. A normal variable exceeds 8 of them once in 10¹⁵ pixels.
        still: there is no sample that moves, nor gaps in it.
    """
    found, beside = np.zeros(view.shape, np.bool_), [image for image in (before, after) if image is not None]
    first, *others = beside or [np.zeros_like(view)] * 2
    second, against = others[0] if others else first, others[0] if others else view
    noise, change = _noise_and_change(view, first, second)
    limit = threshold * max(noise / _MEDIAN, _LEAST)
    if change > 1 + _LEAST:
        first, second = first * np.float32(change), second * np.float32(change)
        against = second if others else view
    beam = 1.0 if beside and not still else np.inf
    return found, _mark(view, first, second, against, limit, beam, threshold / _MEDIAN, found)


@njit(nogil=True, cache=True)
def _noise_and_change(view, before, after):  # type: ignore[no-untyped-def]
    """Medians over some lit pixels: of the difference to the next one, and of the light over that of the brighter
    neighbour (0 where none is lit, or the sum is no larger)."""
    rows, cols = view.shape
    step = max(1, rows * cols // _SAMPLE)
    differences, ratios = np.empty((2, rows * cols // step + 1), np.float32)
    n = lit = 0
    more = 0.0
    for at in range(0, rows * cols, step):
        r, c = at // cols, at % cols
        if c + 1 < cols and view[r, c] > _OPAQUE:
            differences[n] = abs(view[r, c + 1] - view[r, c])
            n += 1
        usual = max(before[r, c], after[r, c])
        if usual > _OPAQUE:
            ratios[lit] = view[r, c] / usual
            more += view[r, c] - usual
            lit += 1
    noise = np.median(differences[:n]) if n > _FEWEST else 0.0
    return noise, np.median(ratios[:lit]) if more > 0 else 0.0


@njit(nogil=True, cache=True)
def _mark(  # type: ignore[no-untyped-def]
    view, before, after, against, limit, beam, errors, found
):
    """Mark the spots of `spots`, and count the pixels of larger ones: `against` is compared with the view before around
    them; `beam`: √light of the open beam, inf where no sample has gaps; `errors`: the threshold over the median
    difference of two normal variables."""
    rows, cols = view.shape
    differences = np.empty((2 * _AROUND + 1) ** 2, np.float32)
    left, brightest = 0, beam
    for r in range(rows):
        for c in range(cols):
            brightest = max(brightest, min(before[r, c], after[r, c]))
    for r in range(rows):
        for c in range(cols):
            light = view[r, c]
            stray = light > brightest + limit
            if light <= before[r, c] + limit or (not stray and light <= after[r, c] + limit):
                continue
            along, down = -np.inf, -np.inf  # the least light of the brightest piece of its line that is no spot
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
            height = light - max(around, before[r, c])
            if height > limit:
                n = 0
                for i in range(max(0, r - _AROUND), min(rows, r + _AROUND + 1)):
                    for j in range(max(0, c - _AROUND), min(cols, c + _AROUND + 1)):
                        differences[n] = abs(before[i, j] - against[i, j])
                        n += 1
                found[r, c] = height > errors * np.median(differences[:n])
            left += stray and height <= limit
    return left
