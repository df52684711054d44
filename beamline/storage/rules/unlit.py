"""Light of single views: none, as with the shutter closed, or two or three lights in turn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.flats_with_sample import lit_places
from beamline.monitor.references import BRIGHT, ReferenceLimits, lights_in_turn
from beamline.storage.readers.base import ScanSource, read_known
from beamline.storage.readers.transforms import selected
from beamline.storage.rules import Finding
from beamline.storage.rules.references import BRIGHTER, VIEWS, ReferenceGroups, cells_of, mean_cells
from drivers.base.frame import FrameKind
from recon.base.arrays import F32, F64, median_deviation
from recon.base.views import spread

LEAST = 0.01  # share of the light of the brightest views, in a view's own bright part: all matter leaves that much open
_SUSPECT = 0.1  # share of the flats' light from which a view is not looked at more closely
_ACROSS = 16  # cells a side, at most
_IN_A_ROW, _BESIDE = 12, np.radians(20.0)  # views looked at; between them: a wide sample differs from farther sides
_AS_GOOD = 0.8  # of the light of the best step, beside its flats: a sample takes as much of others
_TAIL = 1.2816  # standard deviations: BRIGHT percent of noise are below


@dataclass(frozen=True, eq=False)
class ViewLight:
    """Brightness of whole views relative to the flats; not of single bands of rows, where a sample may be opaque.

    Attributes:
        dark, flat: float32 [cell row, cell col], means; a scan of line integrals has none.
        usual: brightness of the brightest of some views, see `brightness`; 1 where there is none yet.
        known: frames that were looked at, and whether they have light.
    """

    source: ScanSource
    dark: F32 | None
    flat: F32 | None
    usual: float
    known: dict[int, bool] = field(default_factory=dict)

    @classmethod
    def of(cls, source: ScanSource, used: ReferenceGroups | None) -> ViewLight:
        """The light from these darks and flats, and some views; None if the scan has line integrals."""
        views = np.flatnonzero(source.image_key == FrameKind.PROJECTION)
        if used is None:
            return cls(source, None, None, 1.0)
        dark, flat = (mean_cells(source, np.concatenate(groups)) for groups in (used.darks, used.flats))
        seen = [brightness(cells, dark, flat) for cells in cells_of(source, spread(views, VIEWS))]
        return cls(source, dark, flat, float(np.percentile(seen, BRIGHT)) if seen else 1.0)

    def suspect(self, data: NDArray[np.generic], dark: F32 | None, flat: F32 | None) -> NDArray[np.bool_]:
        """bool [view]: views that are dark or uniform in the pixels read, which may be a band of rows.

        Args:
            data: [view, row, col], as read.
            dark, flat: [row, col], of the same pixels; None: line integrals.
        """
        uniform = np.array([view.min() == view.max() for view in data], np.bool_)
        if dark is None or flat is None or not len(data):
            return uniform
        views, (dark, flat) = np.stack([_binned(view) for view in data]), map(_binned, (dark, flat))
        lit, least = lit_places(flat - dark), _SUSPECT * max(self.usual, 0.0)
        shares = (views[:, lit] - dark[lit]) / (flat - dark)[lit]
        dim = np.ones(len(data), np.bool_)
        if lit.any():
            dim = ~(np.isfinite(shares).all(axis=1) & (np.median(shares, axis=1) >= least))
        dim[dim] = [brightness(view, dark, flat) < least for view in views[dim]]  # that of the others is no less
        return uniform | dim

    def unlit(self, frame: int) -> bool:
        """Whether a whole view is dark, or uniform while the flats are not."""
        if frame not in self.known:
            self.known[frame] = not self._unlit(frame)
        return not self.known[frame]

    def _unlit(self, frame: int) -> bool:
        image = read_known(self.source, [frame])[0]
        if frame in self.source.unreadable:
            return False  # it is named and left out by who reads it
        if not np.isfinite(image).any():
            return True
        same = bool(image.min() == image.max())
        if self.dark is None or self.flat is None:
            return same
        bright = brightness(cells_of(self.source, np.array([frame]))[0], self.dark, self.flat)
        return bright < LEAST * self.usual or (same and bool(np.ptp(self.flat) > 0))


def light_one(source: ScanSource) -> Iterator[Finding]:
    """Views in a row have one light, but for a drift; else which step takes one, with its flats."""
    darks, flats, views = (
        np.flatnonzero(source.image_key == kind) for kind in (FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION)
    )
    some, dark = (views[:_IN_A_ROW], views[-_IN_A_ROW:]), mean_cells(source, darks) if darks.size else 0.0
    if source.quantity != "counts" or not flats.size or views.size < _IN_A_ROW:
        return
    if (
        any(np.ptp(part) >= part.size for part in some)
        or not np.median(np.abs(np.diff(source.angles[some[0]]))) <= _BESIDE
    ):
        return

    def levels(rows: NDArray[np.int64]) -> F64:
        light = [np.percentile(np.nan_to_num(cells) - dark, BRIGHT) for cells in cells_of(source, rows[:_IN_A_ROW])]
        return np.asarray(np.log(np.maximum(light, 1e-30)), np.float64)

    n, again = (lights_in_turn(levels(part)) for part in some)
    change, most = np.ptp(levels(some[0])), ReferenceLimits().uneven
    if not n or n != again or change < most:
        return
    shares, middles = np.zeros(n), np.zeros((2, n))
    for first in range(n):
        keys = selected(source, slice(first, None, n)).image_key
        own = [levels(np.flatnonzero(keys == kind)) for kind in (FrameKind.FLAT, FrameKind.PROJECTION)]
        if np.ptp(own[0]) < most:
            middles[:, first] = [np.median(each) for each in own]
            share = np.exp(middles[1, first] - middles[0, first])
            shares[first] = share if share <= 1 + BRIGHTER else 0.0
    turned = lights_in_turn(levels(flats))
    if turned and np.prod(middles - middles.mean(axis=1, keepdims=True), axis=0).sum() < 0:
        shares[:] = 0.0  # the brighter views would go with the darker flats
    steps = [f"--frames {first}::{n}" for first in range(n) if 0 < shares[first] >= _AS_GOOD * shares.max()]
    way = f"{' or '.join(steps)} takes one, with its darks and flats (views are counted from 0)."
    no_way = f"No step, as --frames 0::{n}, takes views with flats of their light: give --darks and --flats, too."
    yield Finding(
        "error" if turned else "warning",
        "light",
        f"The views have {n} lights in turn, from frame to frame (from frame {views[0]} on; {np.expm1(change):.0%} "
        f"apart): thresholds, exposures or energies, of which a volume takes one. {way if steps else no_way}",
    )


def brightness(view: F32, dark: F32, flat: F32) -> float:
    """Brightness of a view's bright part relative to the flats, corrected for the bias by noise; from images of
    cells."""
    light = flat - dark
    lit = lit_places(light)
    if not lit.any():
        return 1.0
    share = np.where(lit, (view - dark) / np.where(lit, light, 1), np.nan)
    change = np.diff(share, axis=1)
    noise = median_deviation(change) / 2**0.5
    known = share[np.isfinite(share)]
    if not known.size:
        return 0.0
    return max(float(np.median(known)), float(np.percentile(known, BRIGHT)) - _TAIL * noise)


def _binned(image: NDArray[np.generic]) -> F32:
    """Means [cell row, cell col] of an image; cells at the lower and right edge may be smaller."""
    starts = [np.arange(0, n, -(-n // _ACROSS)) for n in image.shape]
    sums = np.nan_to_num(image).astype(np.float64, copy=False)
    for axis, at in enumerate(starts):
        sums = np.add.reduceat(sums, at, axis=axis)
    each = [np.diff(np.append(at, n)) for at, n in zip(starts, image.shape, strict=True)]
    return np.asarray(sums / np.multiply.outer(*each), np.float32)
