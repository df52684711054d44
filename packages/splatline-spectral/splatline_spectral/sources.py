"""Sources: a scene, a file or a series of scans becomes curves of absorption over energy."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from beamline.core.errors import ConfigError, DataError
from splatline_spectral.contrast import LEAST, Reals, Series, XafsCurve, contrast_of, curve_of, find_edge
from splatline_spectral.measured import PixelBox, open_measured
from splatline_spectral.results import XafsResult

_MOST = 5000


@dataclass(frozen=True)
class Jobs:
    """Which curves of each source.

    Attributes:
        low, high, step: keV; of a file's energies `low` and `high` keep a part.
        material, seed, charges: of a scene; no charges: its own.
        regions, around, unit: of a file; (row, end, column, end) of the material, and around it.
    """

    low: float | None = None
    high: float | None = None
    step: float = 0.001
    material: str | None = None
    seed: int = 0
    charges: Sequence[float] = field(default=())
    regions: Sequence[PixelBox] = field(default=())
    around: PixelBox | None = None
    unit: str | None = None


def results_of(sources: Sequence[str], jobs: Jobs, progress: Callable[[int, int], object]) -> list[XafsResult]:
    """The curve and the edge of each source, region and state of charge.

    Args:
        progress: gets how many of how many energies of a curve are done.

    Raises:
        ConfigError, DataError: a scene or file is wrong, or has too few energies.
    """
    results = []
    for source in sources:
        is_scene = Path(source).suffix.lower() in (".yaml", ".yml", "") and not Path(source).is_dir()
        variants: Sequence[float | PixelBox | None] = (jobs.charges if is_scene else jobs.regions) or (None,)
        for variant in variants:
            with _opened(source, jobs, is_scene, variant) as series:
                curve = series if isinstance(series, XafsCurve) else _curve(series, progress)
                title = Path(source).name if isinstance(series, XafsCurve) else series.title
            if curve.energies.size < LEAST:
                raise DataError(
                    f"{source}: {curve.energies.size} usable energies are too few for an edge, which takes {LEAST}; "
                    f"{curve.left_out.size} were too dark, too bright or without values. Nothing was written."
                )
            name = title if len(variants) == 1 else f"{title}, {variant}"
            edge = find_edge(curve.energies, curve.absorption)
            results.append(XafsResult(name, curve, edge, () if isinstance(series, XafsCurve) else series.elements))
    return results


@contextmanager
def _opened(source: str, jobs: Jobs, is_scene: bool, variant: float | PixelBox | None) -> Iterator[Series | XafsCurve]:
    if not is_scene:
        region = variant if isinstance(variant, tuple) else None
        span = jobs.low or 0.0, jobs.high or math.inf
        with open_measured(Path(source), span, region, jobs.around, jobs.unit) as opened:
            yield opened
        return
    from splatline_spectral.scene import series_of_scene  # xraylib, which no measured file needs

    charge = variant if isinstance(variant, float) else None
    yield series_of_scene(source, _grid(jobs), jobs.material, jobs.seed, charge)


def _grid(jobs: Jobs) -> Reals:
    """Energies from low to high, keV."""
    if jobs.low is None or jobs.high is None:
        raise ConfigError("A scene needs a range of energies: --from 8.30 --to 8.42, in keV. Nothing was simulated.")
    n = math.floor((jobs.high - jobs.low) / jobs.step * (1 + 1e-9) + 1e-9) + 1
    if not LEAST <= n <= _MOST:
        raise ConfigError(
            f"From {jobs.low:g} to {jobs.high:g} keV in steps of {jobs.step:g} are {max(n, 0)} energies; it must be "
            f"{LEAST} to {_MOST}. Nothing was simulated."
        )
    return jobs.low + jobs.step * np.arange(n, dtype=np.float64)


def _curve(series: Series, progress: Callable[[int, int], object]) -> XafsCurve:
    energies, points = list[float](), list[tuple[float, float]]()
    for energy, frame in series.frames:
        energies.append(energy)
        points.append(contrast_of(frame, series.regions))
        progress(len(points), series.n)
    return curve_of(np.array(energies), points, series.regions)
