"""Scans: the energies of a series of scans as radiographs, each the mean of views from all sides."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.features.xafs.radiographs import EVERYTHING, FramePart, line_integrals
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import open_scan
from drivers.base.frame import FrameKind

Reals = NDArray[np.float64]

_MOST_VIEWS = 32  # evenly spread: more say little more of a region, and take long to read


class ScanRadiographs:
    """The scans of one sample, one at each energy.

    The mean over views from all sides shows a region of the detector alike at all energies, though each scan has angles
    of its own.

    Raises:
        DataError: a scan does not state its energy, or frames differ in size.
    """

    def __init__(self, scans: Sequence[Path]) -> None:
        self._scans, energies, shapes = list(scans), list[float](), set[tuple[int, int]]()
        for path in scans:
            with open_scan(path) as source:
                if source.energy_kev is None:
                    raise DataError(
                        f"{path} does not state its energy; expected /entry/instrument/beam/incident_energy. "
                        "Nothing was written."
                    )
                energies.append(source.energy_kev)
                shapes.add(source.shape)
        if len(shapes) != 1:
            sizes = ", ".join(f"{rows} x {cols}" for rows, cols in sorted(shapes))
            raise DataError(f"The scans have frames of {sizes} pixels; expected one size. Nothing was written.")
        self.energies, (self.shape,) = np.array(energies), shapes

    def line_integrals(self, which: Sequence[int], part: FramePart = EVERYTHING) -> Iterator[tuple[float, Reals]]:
        """(keV, line integrals [row, col]) of the scans `which`, in that order, of a part of each frame; +inf and NaN
        as those of `Radiographs`."""
        for i in which:
            with open_scan(self._scans[i]) as source:
                dark = _mean(source, FrameKind.DARK, part)
                flat = _mean(source, FrameKind.FLAT, part) - dark
                views = _chosen(source, FrameKind.PROJECTION)
                scale = np.nanmean(source.exposures[views]) / np.nanmean(source.exposures[_all(source, FrameKind.FLAT)])
                flat = flat * (scale if np.isfinite(scale) else 1.0)
                total = sum(line_integrals(_frame(source, view, part) - dark, flat) for view in views)
                yield float(self.energies[i]), np.asarray(total / views.size, np.float64)


def _all(source: ScanSource, kind: FrameKind) -> NDArray[np.int64]:
    frames = np.flatnonzero(source.image_key == kind)
    if not frames.size:
        raise DataError(f"{source.path} has no {kind.name.lower()}s. Nothing was written.")
    return frames


def _chosen(source: ScanSource, kind: FrameKind) -> NDArray[np.int64]:
    frames = _all(source, kind)
    return frames[np.unique(np.linspace(0, frames.size - 1, _MOST_VIEWS).round().astype(int))]


def _frame(source: ScanSource, index: int, part: FramePart) -> Reals:
    counts = source.read(np.array([index]), part[0])[0][:, part[1]]
    values = counts.astype(np.float64)
    if counts.dtype.kind in "ui":
        values[counts == np.iinfo(counts.dtype).max] = np.nan
    return values


def _mean(source: ScanSource, kind: FrameKind, part: FramePart) -> Reals:
    chosen = _chosen(source, kind)
    return np.asarray(sum(_frame(source, index, part) for index in chosen) / chosen.size, np.float64)
