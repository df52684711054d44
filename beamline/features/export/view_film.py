"""The views of a scan as the images of a film: line integrals, in the order of their angles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.sinks import Warn
from beamline.features.export.film_file import FilmImages, thinned
from beamline.projections.correction import NoViewError, ScanCorrection
from beamline.projections.selection import Selection
from beamline.storage.readers.base import ScanSource
from drivers.base.frame import FrameKind

_BYTES = 2**26  # of views that are corrected together
_LOOKED_AT = 9  # views that tell the grey window


def views_by_angle(source: ScanSource, side: int, warn: Warn) -> FilmImages:
    """The views of a scan by flats and darks, binned where that leaves `side` pixels or more; those unlit are left out.

    Raises:
        DataError: it has no view whose angle is known; while the images are read: none of these views can be used.
    """
    views = np.flatnonzero((source.image_key == FrameKind.PROJECTION) & np.isfinite(source.angles))
    if not views.size:
        raise DataError(f"{source.path} has no projection whose angle is known. Nothing was written.")
    views = views[np.argsort(source.angles[views], kind="stable")]
    shown = views[list(thinned(views.size))].tolist()
    binning = max(1, max(source.shape) // side)
    correction = ScanCorrection(source, Selection(binning=min(binning, *source.shape)), warn)
    at_once = max(1, _BYTES // (4 * source.shape[0] * source.shape[1]))

    def images(frames: Sequence[int]) -> Iterator[NDArray[np.float32]]:
        unusable, given = None, 0
        for first in range(0, len(frames), at_once):
            batch = np.sort(np.asarray(frames[first : first + at_once], np.int64))
            try:
                corrected = correction.at_once(batch)
            except NoViewError as error:
                unusable = error
                continue
            by_frame = dict(zip(corrected.view_ids.tolist(), corrected.data, strict=True))
            given += len(by_frame)
            yield from (by_frame[frame] for frame in frames[first : first + at_once] if frame in by_frame)
        if unusable is not None and not given:
            raise unusable

    few = [shown[i] for i in np.unique(np.linspace(0, len(shown) - 1, _LOOKED_AT).astype(int))]
    height, width = source.row_pitch_mm, source.pixel_size_mm
    ratio = 1.0 if height is None or width is None else height / width
    return FilmImages(shown, lambda: images(shown), lambda: images(few), ratio)
