"""Series: radiographs taken energy by energy into a curve, with word of how far it is, and an early end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beamline.core.events import Event, Sink
from beamline.xafs.contrast import Curve, Regions, curve_of, measured
from drivers.clock import Clock

Reals = NDArray[np.float64]

SAY_EVERY = 0.1  # real s between `progress` events


@dataclass(frozen=True, eq=False)
class Series:
    """Radiographs to be taken.

    Attributes:
        what: whose absorption it will be.
        n: how many.
        frames: (keV, line integrals [row, col]) of each energy, in any order; +inf where a pixel is dark, NaN where
            nothing is known of it.
        regions: what is compared in them.
    """

    what: str
    n: int
    frames: Iterable[tuple[float, Reals]]
    regions: Regions


@dataclass(frozen=True, eq=False)
class Taken:
    """A curve; `cut` where somebody ended it before its last energy."""

    curve: Curve
    cut: bool = False


def take(series: Series, sink: Sink, clock: Clock, stopped: Callable[[], bool]) -> Taken:
    """The curve of a series of radiographs.

    Args:
        sink: takes `progress` events (n, of, per_s, eta_s).
        stopped: asked after each energy.
    """
    energies: list[float] = []
    points: list[tuple[float, float]] = []
    begun = said = time.monotonic()
    cut = False
    for energy, frame in series.frames:
        energies.append(energy)
        points.append(measured(frame, series.regions))
        now, done = time.monotonic(), len(points)
        if now - said >= SAY_EVERY or done == series.n:
            said, rate = now, done / max(now - begun, 1e-9)
            data = {"stage": "xafs", "n": done, "of": series.n, "per_s": rate, "eta_s": (series.n - done) / rate}
            sink(Event("progress", clock.now(), data))
        if done < series.n and stopped():
            cut = True
            break
    return Taken(curve_of(np.array(energies), points, series.regions), cut)
