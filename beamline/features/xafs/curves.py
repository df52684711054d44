"""Curves of `beamline xafs`: a scene, a file or a series of scans becomes absorption over energy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import Sink
from beamline.core.flag import PixelBox
from beamline.core.sinks import Warnings
from beamline.core.stop import StopRequest
from beamline.features.xafs.contrast import LEAST, XafsCurve
from beamline.features.xafs.measured import FileOptions, open_series
from beamline.features.xafs.series import Series, SeriesResult, run_series
from drivers.base.clock import SystemClock

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
