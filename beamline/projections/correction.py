"""Corrector: frames of a scan become line integrals as they are read, by the references that the scan has."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from beamline.core.errors import DataError
from beamline.projections.read import read_binned, read_references
from beamline.projections.selection import Selection, rows_of
from beamline.storage.readers.base import ScanSource
from recon.prep.correct import CorrectionSettings, Projections, References, correct

Warn = Callable[[str], None]
"""Is told, in a sentence, of what is not as it should be though work goes on."""


class Corrector:
    """Reads frames of one scan as line integrals, in the rows and with the binning asked for."""

    def __init__(self, source: ScanSource, selection: Selection, warn: Warn) -> None:
        """Read the reference frames of a scan that `refuse` has nothing against.

        Raises:
            ConfigError: rows or binning that do not fit the detector.
        """
        self._source, self._settings, self._warn = source, selection.correction, warn
        self.rows, self.binning = rows_of(source, selection), selection.binning
        self.references: References | None = None
        if source.quantity == "counts":
            self.references = read_references(source, self.rows, self.binning)

    def line_integrals(
        self, frames: NDArray[np.int64], rows: slice | None = None, settings: CorrectionSettings | None = None
    ) -> Projections:
        """Line integrals of `frames` (rows of the file), without those that hold no finite pixel: see `view_ids`.

        Args:
            frames: rows of the file.
            rows: narrows the detector rows, in binned rows.
            settings: other than the selection's.

        Raises:
            DataError: frames that cannot be corrected; the message names the file.
        """
        first, end = self.rows.start, self.rows.stop
        if rows is not None:
            start, stop, _ = rows.indices((end - first) // self.binning)
            first, end = first + start * self.binning, first + stop * self.binning
        data = read_binned(self._source, frames, slice(first, end), self.binning)
        alive = np.isfinite(data).any(axis=(1, 2))
        if not alive.any():
            raise DataError(f"{self._source.path}: none of the pixels of the {len(frames)} views is a finite number.")
        if not alive.all():
            lost = frames[~alive]
            self._warn(f"{lost.size} of {len(frames)} views hold no finite pixel (first: frame {lost[0]}): left out.")
            data, frames = data[alive], frames[alive]
        if self.references is None:
            return _as_given(data, frames)
        references = self.references if rows is None else _narrowed(self.references, rows)
        try:
            return correct(data, frames.astype(np.float64), references, settings or self._settings, view_ids=frames)
        except ValueError as error:
            raise DataError(f"{self._source.path} cannot be corrected: {error}") from error


def _narrowed(references: References, rows: slice) -> References:
    return References(references.dark[rows], tuple((position, flat[rows]) for position, flat in references.flats))


def _as_given(data: NDArray[Any], frames: NDArray[np.int64]) -> Projections:
    """Line integrals that need no correction; a pixel that is not finite takes the value of the nearest that is."""
    data = data.astype(np.float32, copy=False)
    bad = ~np.isfinite(data)
    for view in np.flatnonzero(bad.any(axis=(1, 2))):
        nearest = ndimage.distance_transform_edt(bad[view], return_distances=False, return_indices=True)
        data[view] = data[view][tuple(nearest)]
    ones = np.ones(len(frames), np.float32)
    return Projections(
        data, frames, floored=0.0, air=ones, masked=np.asarray(bad.all(axis=0)), replaced=float(bad.mean())
    )
