"""Series: computes a curve from radiographs energy by energy, with progress events and an early end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beamline.core.events import Counted, Sink
from beamline.core.machine_speed import seconds_left
from beamline.features.xafs.contrast import ContrastRegions, XafsCurve, contrast_of, curve_of
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
