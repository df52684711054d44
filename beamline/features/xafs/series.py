"""Series: radiographs become a curve, energy by energy, with progress and an early end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.durations import seconds_left
from beamline.core.errors import DataError
from beamline.core.events import Counted, Sink
from beamline.features.xafs.contrast import ContrastRegions, XafsCurve, contrast_of, curve_of
from beamline.storage import hdf5
from drivers.base.clock import Clock

Reals = NDArray[np.float64]

REPORT_EVERY = 0.1  # s between `progress` events


@dataclass(frozen=True, eq=False)
class Series:
    """Radiographs of a material at several energies.

    Attributes:
        title: what is scanned.
        n: number of energies.
        frames: (keV, line integrals [row, col]) of each energy, in any order; +inf where a pixel is dark, NaN
            without a value.
        regions: pixels that are compared.
        material, elements: name and atomic numbers of the material; empty: not known.
    """

    title: str
    n: int
    frames: Iterable[tuple[float, Reals]]
    regions: ContrastRegions
    material: str = ""
    elements: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class SeriesResult:
    """A curve; `stopped` where it ended before its last energy. `material`, `elements`: as of the series."""

    curve: XafsCurve
    stopped: bool = False
    material: str = ""
    elements: tuple[int, ...] = ()


def run_series(series: Series, sink: Sink, clock: Clock, should_stop: Callable[[], bool]) -> SeriesResult:
    """The curve of a series of radiographs.

    Args:
        sink: gets `progress` events (n, of, per_s, eta_s).
        should_stop: called after each energy; true ends the series.
    """
    energies: list[float] = []
    points: list[tuple[float, float]] = []
    start = reported = time.monotonic()
    stopped = False
    for energy, frame in series.frames:
        energies.append(energy)
        points.append(contrast_of(frame, series.regions))
        now, done = time.monotonic(), len(points)
        if now - reported >= REPORT_EVERY or done == series.n:
            reported, spent = now, max(now - start, 1e-9)
            eta = seconds_left(done, series.n, spent) or 0.0
            sink(Counted("xafs", done, series.n, done / spent, eta, time=clock.now()))
        if done < series.n and should_stop():
            stopped = True
            break
    curve = curve_of(np.array(energies), points, series.regions)
    return SeriesResult(curve, stopped, series.material, series.elements)


FramePart = tuple[slice, slice]

EVERYTHING = (slice(None), slice(None))
_LIT, _LIT_SHARE = (
    0.5,
    1e-3,
)  # light: counts above the dark level, or share of the flat where that is less (flats of 1)


@dataclass(frozen=True, eq=False)
class Radiographs:
    """A file of frames over energies, open for reading."""

    energies: Reals  # keV, [n]
    frames: h5py.Dataset  # dataset [n, row, col]
    flats: h5py.Dataset | None  # [n, row, col], or [row, col] for all energies; None where frames are line integrals
    darks: h5py.Dataset | None  # [row, col] or [k, row, col], of the same unit as frames; None: no dark level

    @property
    def shape(self) -> tuple[int, int]:
        return int(self.frames.shape[1]), int(self.frames.shape[2])

    def line_integrals(self, which: Sequence[int], part: FramePart = EVERYTHING) -> Iterator[tuple[float, Reals]]:
        """(keV, line integrals [row, col]) of the frames `which`, in that order, of a part of each. +inf where no light
        was transmitted, NaN without a value, also for integers that are the largest of their type.

        Raises:
            DataError: the file cannot be read.
        """
        try:
            dark = _mean(self.darks, part)
            flat = None if self.flats is None or self.flats.ndim == 3 else _mean(self.flats, part) - dark
            for i in which:
                frame = counts_in(self.frames[i, part[0], part[1]])
                if self.flats is not None:
                    own = counts_in(self.flats[i, part[0], part[1]]) - dark if flat is None else flat
                    frame = line_integrals(frame - dark, own)
                yield float(self.energies[i]), frame
        except OSError as error:  # h5py's form of HDF5's errors
            raise DataError(f"{self.frames.file.filename} cannot be read ({hdf5.reason(error)}).") from error


def _mean(item: h5py.Dataset | None, part: FramePart) -> Reals:
    """Mean of the frame or frames of a dataset, read one by one; 0 without a dataset."""
    if item is None:
        return np.zeros(1)
    if item.ndim == 2:
        return counts_in(item[part])
    total = sum((counts_in(item[i, part[0], part[1]]) for i in range(item.shape[0])), start=np.zeros(1))
    return np.asarray(total / item.shape[0])


def counts_in(values: Any) -> Reals:
    """NaN where integers are the largest of their type: the pixel may be saturated."""
    counts = np.asarray(values, dtype=np.float64)
    if values.dtype.kind in "ui":
        counts[values == np.iinfo(values.dtype).max] = np.nan
    return counts


def line_integrals(signal: Reals, flat: Reals) -> Reals:
    """-log(signal / flat), [row, col], of counts above the dark level. +inf where no light was transmitted, NaN where
    the flat is dark too, or where one of them is not finite."""
    lit = np.minimum(_LIT, _LIT_SHARE * flat)
    out = np.full(np.broadcast_shapes(signal.shape, flat.shape), np.nan)
    known = np.isfinite(signal) & (flat > 0) & (flat < np.inf)
    np.log(np.divide(flat, signal, where=known & (signal > lit), out=out), where=known & (signal > lit), out=out)
    out[known & (signal <= lit)] = np.inf
    return out
