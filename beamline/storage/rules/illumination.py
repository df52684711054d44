"""Illumination: which projections of a scan have beam, judged from whole projections. A band of rows would not do,
because the sample may be opaque there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.evidence import BRIGHT, lit_places
from beamline.storage.readers.base import ScanSource, read_known
from recon.base.arrays import F32, I64
from recon.base.noise import deviation_between_neighbours
from recon.base.views import spread

VIEWS = 32  # number of projections, from the whole scan, that are compared with the flats
# fraction of the brightest projections' intensity that the bright part of every projection exceeds, because the sample
# does not cover the whole frame
LEAST = 0.01
_SUSPECT = 0.1  # share of the scan's brightest projections: a brighter projection is not examined more closely
_ACROSS = 32  # approximate number of pixels along each side in which a projection is first checked
_TAIL = 1.2816  # standard deviations of the noise: BRIGHT percent of the noise are below


@dataclass(frozen=True, eq=False)
class Illumination:
    """Checks which projections have beam, each of them once.

    Attributes:
        source: reads the frames.
        views: rows of the projections.
        dark_and_flat: cells [cell row, cell col] of the mean dark and of the mean flat; None: the projections are not
            divided by flats.
        cells_of: function that gives the cells of a row.
    """

    source: ScanSource
    views: I64
    dark_and_flat: tuple[F32, F32] | None
    cells_of: Callable[[int], F32]
    _has_beam: dict[int, bool] = field(init=False, default_factory=dict)

    @cached_property
    def brightest(self) -> float:
        """Brightness, relative to the flats, of the brightest of some projections (see `brightness`); 1 if there are no
        projections.
        """
        if self.dark_and_flat is None:
            return 1.0
        brightnesses = [
            brightness(self.cells_of(row), *self.dark_and_flat) for row in spread(self.views, VIEWS).tolist()
        ]
        return float(np.percentile(brightnesses, BRIGHT)) if brightnesses else 1.0

    def suspect(self, data: NDArray[np.generic], dark_and_flat: tuple[F32, F32] | None) -> NDArray[np.bool_]:
        """bool [view], True if a projection is dark or uniform in the given pixels, which may be a band of rows.

        Args:
            data: [view, row, col], as read.
            dark_and_flat: [row, col] of the same pixels; None: the data are line integrals.
        """
        uniform = np.array([view.min() == view.max() for view in data], np.bool_)
        if dark_and_flat is None or not len(data):
            return uniform
        sampled = tuple(slice(None, None, max(1, n // _ACROSS)) for n in dark_and_flat[0].shape)
        dark, intensity = dark_and_flat[0][sampled], (dark_and_flat[1] - dark_and_flat[0])[sampled]
        exposed, least = lit_places(intensity), _SUSPECT * max(self.brightest, 0.0)
        shares = [
            np.median((view[sampled] - dark)[exposed] / intensity[exposed]) if exposed.any() else 0.0 for view in data
        ]
        return uniform | ~(np.array(shares) >= least)

    def without_beam(self, row: int) -> bool:
        """True if a whole projection is dark, or if it is uniform while the flats are not; each projection is checked
        once."""
        if row not in self._has_beam:
            self._has_beam[row] = not self._is_without_beam(row)
        return not self._has_beam[row]

    @property
    def known_without_beam(self) -> list[int]:
        """The projections without beam, among the checked ones."""
        return [row for row, has_beam in self._has_beam.items() if not has_beam]

    def _is_without_beam(self, row: int) -> bool:
        image = read_known(self.source, [row])[0]
        if row in self.source.unreadable:
            return False  # the caller names the frame and leaves it out
        if not np.isfinite(image).any():
            return True
        uniform = bool(image.min() == image.max())
        if self.dark_and_flat is None:
            return uniform
        relative_brightness = brightness(self.cells_of(row), *self.dark_and_flat)
        return relative_brightness < LEAST * self.brightest or (uniform and bool(np.ptp(self.dark_and_flat[1]) > 0))


def brightness(view: F32, dark: F32, flat: F32) -> float:
    """Brightness of the bright part of a projection relative to the flats, from images of cells. It is corrected for
    the bias that noise causes.
    """
    intensity = flat - dark
    exposed = lit_places(intensity)
    if not exposed.any():
        return 1.0
    share = np.where(exposed, (view - dark) / np.where(exposed, intensity, 1), np.nan)
    noise = deviation_between_neighbours(share)
    known = share[np.isfinite(share)]
    if not known.size:
        return 0.0
    return max(float(np.median(known)), float(np.percentile(known, BRIGHT)) - _TAIL * noise)
