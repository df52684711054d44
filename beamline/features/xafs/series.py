"""Series: a scene, a file or a series of scans becomes absorption over energy, energy by energy."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import Counted, Sink
from beamline.core.flag import PixelBox
from beamline.core.machine_speed import seconds_left
from beamline.core.sinks import Warnings
from beamline.core.stop import StopRequest
from beamline.features.xafs.contrast import LEAST, ContrastRegions, XafsCurve, contrast_of, curve_of
from beamline.storage import hdf5
from drivers.base.clock import Clock, SystemClock

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
                frame = _counts(self.frames[i, part[0], part[1]])
                if self.flats is not None:
                    own = _counts(self.flats[i, part[0], part[1]]) - dark if flat is None else flat
                    frame = line_integrals(frame - dark, own)
                yield float(self.energies[i]), frame
        except OSError as error:  # h5py's form of HDF5's errors
            raise DataError(f"{self.frames.file.filename} cannot be read ({hdf5.reason(error)}).") from error


def _mean(item: h5py.Dataset | None, part: FramePart) -> Reals:
    """Mean of the frame or frames of a dataset, read one by one; 0 without a dataset."""
    if item is None:
        return np.zeros(1)
    if item.ndim == 2:
        return _counts(item[part])
    total = sum((_counts(item[i, part[0], part[1]]) for i in range(item.shape[0])), start=np.zeros(1))
    return np.asarray(total / item.shape[0])


def _counts(values: Any) -> Reals:
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


MOST = 5000
_SCENES = (".yaml", ".yml", "")


@dataclass(frozen=True)
class CurveJob:
    """A curve to make: of a source, a region of it, or a state of charge of a scene's material."""

    source: str
    region: PixelBox | None = None
    charge: float | None = None

    @property
    def is_scene(self) -> bool:
        return Path(self.source).suffix.lower() in _SCENES and not Path(self.source).is_dir()


def run_job(
    job: CurveJob, given: Mapping[str, Any], several: bool, sink: Sink, stop: StopRequest
) -> tuple[SeriesResult, str]:
    """The curve of a job and its name; a name tells one of several jobs from the others.

    Args:
        given: options of `beamline xafs` for all curves, by the names of their parameters; None: not given.
    """
    from beamline.features.xafs.measured import FileOptions, open_series  # it takes radiographs from here

    source, low, high = job.source, given["low"], given["high"]
    with ExitStack() as opened:
        series: Series | XafsCurve
        if job.is_scene:
            from beamline.features.xafs.energy_scan import open_energy_scan  # xraylib, which no measured file needs

            energies, angle = _grid(low, high, given["step"] or 0.001), math.radians(given["angle"] or 0.0)
            series = open_energy_scan(
                source, energies, given["material"], angle, given["seed"] or 0, job.charge
            ).series()
        else:
            from beamline.scan.energies import is_series, scans_in

            folder = Path(source)
            warn = Warnings(sink, SystemClock())
            scans = scans_in(folder, warn) if is_series(folder) else ()
            if folder.is_dir() and not scans:
                raise DataError(
                    f"{folder} is no folder of a series of scans (scan.energies); expected one, a file or a scene. "
                    "Nothing was written."
                )
            options = FileOptions(
                low or 0.0, high or math.inf, job.region, given["around"], given["unit"], given["quantity"]
            )
            series = opened.enter_context(open_series(folder, options, scans))
            n = series.energies.size if isinstance(series, XafsCurve) else series.n
            if n < LEAST:
                within = " between --from and --to" if low or high else ""
                raise DataError(f"{source}: {n} energies{within} are too few for an edge, which takes {LEAST}.")
        if isinstance(series, XafsCurve):
            run, title = SeriesResult(series), Path(source).name
        else:
            run, title = run_series(series, sink, SystemClock(), lambda: stop.stopping), series.title
    if several and job.charge is not None:
        title = f"{title}, state of charge {job.charge:g}"
    if several and job.region is not None:
        title = f"{title}, {job.region[0]}:{job.region[1]},{job.region[2]}:{job.region[3]}"
    return run, title


def _grid(low: float | None, high: float | None, step: float) -> NDArray[np.float64]:
    """Energies from low to high, keV. Raises UsageError: a limit is missing, or energies are too few or many."""
    if low is None or high is None:
        raise click.UsageError("A scene needs a range of energies: --from 8.30 --to 8.42, in keV.")
    n = math.floor((high - low) / step * (1 + 1e-9) + 1e-9) + 1
    if not LEAST <= n <= MOST:
        raise click.UsageError(
            f"From {low:g} to {high:g} keV in steps of {step:g} are {max(n, 0)} energies; it must be {LEAST} to {MOST}."
        )
    return low + step * np.arange(n, dtype=np.float64)
