"""Detectors of several modules: pixels in the gaps have a marker value instead of counts, and photon counters have
no darks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.storage.readers.base import ScanSource, read_known
from beamline.storage.readers.frames import Frames, Read
from beamline.storage.readers.transforms import UNPACKED
from drivers.base.frame import FrameKind
from recon.base.arrays import I64, Mask
from recon.base.views import spread

_LOOKED_AT = 3  # frames of each kind that are examined
# share of the pixels: if more of them have the largest value of their type, the cause is light and not a gap
_SATURATED = 1e-3
_UNLIT = 0.05  # share of the bright part of a flat; the noise of darker pixels is mostly not that of light
# relative difference allowed between variance and mean of counted photons, in addition to the statistical error
_PHOTONS = 0.02
_ERRORS = 2.5  # standard deviations of the statistical error that are allowed
_FEWEST = 2000  # least number of pairs of pixels, from which a variance is known to 3 %


def marked_source(base: ScanSource, no_data: Mask) -> tuple[ScanSource, bool]:
    """A scan whose pixels without data are 0 in all frames, including flats, so that the correction replaces them like
    pixels without beam. Also True if the pixels are counted photons, so that the dark is 0 and need not be measured.
    """

    def pixels(read: Read, frames: slice | ArrayLike, rows: slice) -> NDArray[Any]:
        images = read(frames, rows)
        images[:, no_data[rows]] = 0
        return images

    facts = {"pixels_without_data": f"{no_data.mean():.2%}, replaced with the values of neighbouring pixels"}
    not_used = tuple(field for field in base.not_used if field.where != "detector/pixel_mask")
    source = Frames(base, pixels=pixels, not_used=not_used, attributes=lambda known: {**known, **facts})
    counter = not base.table.darks.size and counts_photons(source)
    if counter:
        facts["darks"] = "0 (the flats vary like counted photons, so the detector has no dark signal)"
    return source, counter


def no_data_of(source: ScanSource) -> Mask | None:
    """bool [row, col], True for pixels without data: those in the mask of the file, and those that have a marker value
    in all frames.

    Only integers have marker values: the largest value of an unsigned type, and values below 0 of a signed type. Pixels
    of 8 and 16 bits may also reach the largest value because they are saturated. For these types, only whole rows and
    columns count as marked, and no other pixel may have the largest value. None if no pixel is marked, or more than
    half of them.
    """
    if source.dtype.kind not in "iu":
        return None
    ends = _ends(source) if source.frame_bytes <= UNPACKED else []
    if source.pixel_mask is None and not ends:
        return None
    marked = np.zeros(source.shape, np.bool_) if source.pixel_mask is None else source.pixel_mask.copy()
    if ends:
        in_all = np.logical_and.reduce(ends)
        if source.dtype.itemsize < 4:
            in_all = in_all.all(axis=0) | in_all.all(axis=1)[:, None]
            if max(float((each & ~in_all).mean()) for each in ends) > _SATURATED:
                in_all[:] = False
        marked |= in_all
    return marked if 0 < marked.mean() < 0.5 else None


def examined(source: ScanSource, kind: FrameKind) -> I64:
    """The rows of at most three frames of this kind, spread over the scan, from which its pixels are judged."""
    return spread(source.table.of_kind(kind), _LOOKED_AT)


def _ends(source: ScanSource) -> list[Mask]:
    """For each sampled flat and projection, the pixels with a marker value; [] if a frame has no such pixel."""
    ends = []
    for kind in (FrameKind.FLAT, FrameKind.PROJECTION):
        for row in examined(source, kind):
            ends.append(_end_in(source, int(row)))
            if not ends[-1].any():
                return []
    return ends


def _end_in(source: ScanSource, row: int) -> Mask:
    """The pixels of one frame that have a marker value. The frame is read in two halves to save memory."""
    half = source.shape[0] // 2
    parts = (read_known(source, [row], rows)[0] for rows in (slice(0, half), slice(half, source.shape[0])))
    return np.concatenate([part < 0 if part.dtype.kind == "i" else part == np.iinfo(part.dtype).max for part in parts])


def counts_photons(source: ScanSource) -> bool:
    """True if flats fluctuate like counted photons: their variance equals their mean, so the detector has no offset.

    For a camera, variance over mean is its gain times the share of the counts that comes from light. This share is
    smaller if there is less light, for example in dark corners. Therefore the brighter and the darker half of the
    pixels must give the same result.
    """
    rows = source.table.flats[: 2 * _LOOKED_AT]
    if rows.size < 2 or source.dtype.kind not in "iu":
        return False
    flats = read_known(source, rows).reshape(rows.size, -1).astype(np.float64)
    mean = flats.mean(axis=0)
    lit = mean > _UNLIT * np.percentile(mean, 90)
    level = flats[:, lit].mean(axis=1)
    pairs = (rows.size - 1) * int(lit.sum())
    if pairs < _FEWEST or not level.min() > 0:
        return False
    even, bright = flats * (level.mean() / level)[:, None], mean > np.median(mean[lit])
    ratios = [np.square(np.diff(even[:, part], axis=0)).mean() / 2 / mean[part].mean() for part in (bright, ~bright)]
    return all(abs(float(ratio) - 1) < _PHOTONS + _ERRORS * np.sqrt(4 / pairs) for ratio in ratios)
