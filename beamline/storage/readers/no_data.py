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
from recon.base.arrays import Mask
from recon.base.views import spread

_LOOKED_AT = 3  # frames of a kind
_SATURATED = 1e-3  # of the pixels, from which light, and no gap, is at the end of a type; as the limit of flats
_UNLIT = 0.05  # of the bright part of a flat: darker pixels tell little of the noise of light
_PHOTONS = 0.02  # by which the variance of counted photons may differ from their mean, in addition to its own error
_ERRORS = 2.5  # standard deviations of that error
_FEWEST = 2000  # pairs of pixels, from which a variance is known to 3 %


def marked_source(base: ScanSource, no_data: Mask) -> tuple[ScanSource, bool]:
    """A scan whose pixels without data are 0 in all frames, also in flats, so that they are replaced like pixels
    without beam; and True for counted photons, whose dark is 0 and absent.
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
    """bool [row, col], pixels without data, from the file's mask, or because they are at the maximum of their type in
    all frames.

    Only integers have such markers: the largest value of an unsigned type, and values below 0 of the others. Pixels of
    8 and 16 bits may also reach the largest value because they are saturated. For these types, only whole rows and
    columns count as markers, and no other pixel may have the largest value. None if nothing is marked, or more than
    half.
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


def _ends(source: ScanSource) -> list[Mask]:
    """Pixels at the end of their type in sampled flats and projections; [] if one of these frames has none."""
    ends = []
    for kind in (FrameKind.FLAT, FrameKind.PROJECTION):
        for row in spread(source.table.of_kind(kind), _LOOKED_AT):
            ends.append(_end_in(source, int(row)))
            if not ends[-1].any():
                return []
    return ends


def _end_in(source: ScanSource, row: int) -> Mask:
    """Where one frame is at the end of its type; it is read in two halves, so that no more memory is needed."""
    half = source.shape[0] // 2
    parts = (read_known(source, [row], rows)[0] for rows in (slice(0, half), slice(half, source.shape[0])))
    return np.concatenate([part < 0 if part.dtype.kind == "i" else part == np.iinfo(part.dtype).max for part in parts])


def counts_photons(source: ScanSource) -> bool:
    """True if flats fluctuate like counted photons, with the variance of their mean, so that they have no offset.

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
