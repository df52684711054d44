"""Light of single views: none, as with the shutter closed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.evidence import BRIGHT, lit_places
from beamline.storage.readers.base import ScanSource, read_known
from beamline.storage.rules.references import VIEWS, ReferenceGroups, cells_of, mean_cells
from drivers.base.frame import FrameKind
from recon.base.arrays import F32
from recon.base.noise import deviation_between_neighbours
from recon.base.views import spread

LEAST = 0.01  # share of the light of the brightest views, in a view's own bright part: all matter leaves that much open
_SUSPECT = 0.1  # share of the flats' light from which a view is not looked at more closely
_ACROSS = 32  # pixels a side, about, by which a view is suspected
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
        some = tuple(slice(None, None, max(1, n // _ACROSS)) for n in dark.shape)
        dark, light = dark[some], (flat - dark)[some]
        lit, least = lit_places(light), _SUSPECT * max(self.usual, 0.0)
        shares = [np.median((view[some] - dark)[lit] / light[lit]) if lit.any() else 0.0 for view in data]
        return uniform | ~(np.array(shares) >= least)

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


def brightness(view: F32, dark: F32, flat: F32) -> float:
    """Brightness of a view's bright part relative to the flats, corrected for the bias by noise; from images of
    cells."""
    light = flat - dark
    lit = lit_places(light)
    if not lit.any():
        return 1.0
    share = np.where(lit, (view - dark) / np.where(lit, light, 1), np.nan)
    noise = deviation_between_neighbours(share)
    known = share[np.isfinite(share)]
    if not known.size:
        return 0.0
    return max(float(np.median(known)), float(np.percentile(known, BRIGHT)) - _TAIL * noise)
