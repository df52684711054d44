"""Spots: pixels that a stray gamma or X-ray lit in a single view, found beside the neighbouring views, and filled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, I64, Mask
from recon.base.jit import njit
from recon.base.masks import Image, fill, plan_fill
from recon.base.noise import deviation_between_neighbours
from recon.prep.unmeasured import NO_RUNS

_LEAST = 0.005  # least noise of √light, of that of the open beam: 1 % of its light, as grain of screen and optics
_WIDEST = 3  # pixels of a spot along rows and columns
_AROUND = 3  # pixels on each side of a spot that show how much the views differ there
_NOISE_ROWS = 64  # about, that show the noise of a view
_MEDIAN = 0.954  # of |x - y|, for normal variables of standard deviation 1


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
    """

    data: F32
    view_ids: NDArray[np.int64]
    repaired: NDArray[np.int64]
    air: F32
    beam: F32 | None = None
    unmeasured: I64 = field(default_factory=NO_RUNS.copy)

    def __getitem__(self, part: slice | NDArray[np.intp]) -> Transmission:
        """Some of the views."""
        ids, beam = self.view_ids[part], None if self.beam is None else self.beam[part]
        runs = self.unmeasured[np.isin(self.unmeasured[:, 0], ids)]
        return Transmission(self.data[part], ids, self.repaired[part], self.air[part], beam, runs)

    def and_then(self, later: Transmission) -> Transmission:
        """These views and later ones."""
        pairs = zip(vars(self).values(), vars(later).values(), strict=True)
        joined: list[Any] = [None if first is None else np.concatenate((first, then)) for first, then in pairs]
        return Transmission(*joined)


class SpotFilter:
    """Fills spots of views that come in batches of any size, each view between its neighbours in angle or time.

    The newest view waits for the next one. The result is the same to the bit for any split into batches.
    """

    def __init__(self, threshold: float, root: Callable[[F32], F32]) -> None:
        """Take how views are read.

        Args:
            threshold: see `spots`; inf fills none.
            root: √transmission of the pixels of a view, where the noise of photons is everywhere the same.
        """
        self._threshold, self._root = threshold, root
        self._before: Image | None = None  # the last view that was freed of spots, as `root` reads it
        self._waiting: Transmission | None = None

    @property
    def waiting(self) -> bool:
        """Whether the newest view waits for the one after it."""
        return self._waiting is not None

    def feed(
        self,
        views: Transmission,
        last: bool = True,
        progress: Callable[[int], None] = lambda done: None,
        order: NDArray[np.intp] | None = None,
    ) -> Transmission:
        """The waiting view and these, their spots filled in place; without `last` the newest then waits.

        Args:
            progress: how many views are done, after each.
            order: [view], where each view has its neighbours, beside it; all views are there, and none waits. None:
                their neighbours are those before and after.
        """
        views = views if self._waiting is None else self._waiting.and_then(views)
        total = len(views.data)
        n, order = total if last else max(total - 1, 0), np.arange(total) if order is None else order
        here = self._root(views.data[order[0]]) if n else None
        for done, view in enumerate(order[:n], 1):
            after = self._root(views.data[order[done]]) if done < total else None
            if here is not None and np.isfinite(self._threshold):
                found = spots(here, self._before, after, self._threshold)
                if found.any():
                    views.repaired[view] += found.sum()
                    fill(views.data[view], plan_fill(found))
                    here = self._root(views.data[view])
            self._before, here = here, after
            progress(done)
        self._waiting = views[np.arange(n, total)] if n < total else None
        return views[:n]


def spots(view: Image, before: Image | None, after: Image | None, threshold: float) -> Mask:
    """bool [row, col], pixels that a stray photon lit: brighter than the neighbouring views, and than what is around.

    All images are √transmission, where photon noise is uniform. A spot is at most three pixels wide along its row and
    its column: edges and gaps of a sample are longer, or are in a neighbouring view. A pixel brighter than all of the
    view before is light of no sample: it may be part of a line, and the next view may have a spot there, too.

    Args:
        before, after: the views beside it in angle; None: there is none.
        threshold: standard deviations of the noise by which a spot is brighter. The noise is the largest of three: that
            between the pixels of this view, that between both neighbours around the pixel (the sample turns), and 1 %
            of the light. A normal variable exceeds 8 of them once in 10¹⁵ pixels.
    """
    found, beside = np.zeros(view.shape, np.bool_), [image for image in (before, after) if image is not None]
    limit = threshold * max(deviation_between_neighbours(view[:: max(1, len(view) // _NOISE_ROWS)]), _LEAST)
    first, *others = beside or [np.zeros_like(view)] * 2
    second, against = others[0] if others else first, others[0] if others else view
    brightest = float(first.max()) + limit if beside else np.inf
    _mark(view, first, second, against, limit, brightest, threshold / _MEDIAN, found)
    return found


@njit(nogil=True, cache=True)
def _mark(  # type: ignore[no-untyped-def]
    view, before, after, against, limit, brightest, errors, found
):
    """Mark the spots of `spots`: `against` is compared with the view before around them; `brightest`: from there on
    light is of no sample; `errors`: the threshold over the median difference of two normal variables."""
    rows, cols = view.shape
    differences = np.empty((2 * _AROUND + 1) ** 2, np.float32)
    for r in range(rows):
        for c in range(cols):
            light = view[r, c]
            stray = light > brightest
            if light <= before[r, c] + limit or (not stray and light <= after[r, c] + limit):
                continue
            along, down = -np.inf, -np.inf  # the least light of the brightest piece of its line that is no spot
            for first in range(-_WIDEST, 1):
                if c + first >= 0 and c + first + _WIDEST < cols:
                    along = max(along, view[r, c + first : c + first + _WIDEST + 1].min())
                if r + first >= 0 and r + first + _WIDEST < rows:
                    down = max(down, view[r + first : r + first + _WIDEST + 1, c].min())
            around = min(along, down) if stray and down > -np.inf else max(along, down)
            height = light - max(around, before[r, c] if stray else max(before[r, c], after[r, c]))
            if height <= limit:
                continue
            n = 0
            for i in range(max(0, r - _AROUND), min(rows, r + _AROUND + 1)):
                for j in range(max(0, c - _AROUND), min(cols, c + _AROUND + 1)):
                    differences[n] = abs(before[i, j] - against[i, j])
                    n += 1
            found[r, c] = height > errors * np.median(differences[:n])
