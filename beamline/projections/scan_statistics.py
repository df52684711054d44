"""Statistics of the counts of a scan as they are stored: by kind of frame, before any correction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.report.figures import DPI, WIDTH, png
from beamline.storage.readers.base import ScanSource
from drivers.base.frame import FrameKind
from recon.prep.matter import absorbed_dose

FRAMES = 64  # Frames of a kind that are looked at, spread evenly over all of them
PERCENT = (0.1, 1.0, 50.0, 99.0, 99.9)
_BINS = 2**16  # between the least and the greatest value of real numbers; integers have a bin each


@dataclass(frozen=True, eq=False)
class KindStatistics:
    """Pixel values of the frames of a kind.

    Attributes:
        frames: that were looked at, of `of`.
        minimum, maximum, mean, deviation: of all their pixels that are finite.
        percentiles: at PERCENT, to a count, or to 1/65536 of the range of real numbers.
        saturated: share of pixels at the greatest number of the pixels' type; 0 of real numbers.
        not_finite: share of pixels.
        edges, pixels: the histogram.
    """

    kind: FrameKind
    frames: int
    of: int
    minimum: float
    maximum: float
    mean: float
    deviation: float
    percentiles: tuple[float, ...]
    saturated: float
    not_finite: float
    edges: NDArray[np.float64]
    pixels: NDArray[np.int64]


def statistics_of(source: ScanSource, progress: Callable[[int, int], None]) -> list[KindStatistics]:
    """Of darks, flats and views, as far as there are any. `progress`: frames read, of how many."""
    chosen = {}
    for kind in (FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION):
        rows = np.flatnonzero(source.image_key == kind)
        if rows.size:
            chosen[kind] = rows[np.unique(np.linspace(0, rows.size - 1, FRAMES).round().astype(int))], rows.size
    total, done = 2 * sum(rows.size for rows, _ in chosen.values()), 0

    def image(row: int) -> NDArray[Any]:
        nonlocal done
        done += 1
        progress(done, total)
        return source.read([row])[0]

    return [_of_kind(kind, rows, of, image, source.dtype) for kind, (rows, of) in chosen.items()]


def _of_kind(
    kind: FrameKind, rows: NDArray[np.intp], of: int, image: Callable[[int], NDArray[Any]], dtype: np.dtype[Any]
) -> KindStatistics:
    """Two passes: range, then histogram and moments about a value in the range."""
    low, high, finite, whole = np.inf, -np.inf, 0, 0
    for row in map(int, rows):
        values = image(row)
        good = values[np.isfinite(values)]
        finite, whole = finite + good.size, whole + values.size
        if good.size:
            low, high = min(low, float(good.min())), max(high, float(good.max()))
    if not finite:
        none = (np.nan,) * len(PERCENT)
        return KindStatistics(
            kind, rows.size, of, np.nan, np.nan, np.nan, np.nan, none, 0.0, 1.0, np.zeros(2), np.zeros(1, np.int64)
        )
    whole_numbers = dtype.kind in "iu" and high - low < 2**20
    edges = (
        np.arange(low - 0.5, high + 1) if whole_numbers else np.linspace(low, high if high > low else low + 1, _BINS)
    )
    pixels, total, squares = np.zeros(edges.size - 1, np.int64), 0.0, 0.0
    for row in map(int, rows):
        good = image(row)
        good = good[np.isfinite(good)]
        away = good.astype(np.float64) - low
        if whole_numbers:
            pixels += np.bincount(away.astype(np.int64), minlength=pixels.size)
        else:
            pixels += np.histogram(good, edges)[0]
        total, squares = total + float(away.sum()), squares + float(away @ away)
    mean = total / finite
    below = np.cumsum(pixels)
    at = np.searchsorted(below, np.array(PERCENT) / 100 * finite)
    middles = (edges[1:] + edges[:-1]) / 2
    full = float(np.iinfo(dtype).max) if dtype.kind in "iu" else np.inf
    return KindStatistics(
        kind, rows.size, of, low, high, low + mean, float(np.sqrt(max(squares / finite - mean**2, 0.0))),
        tuple(float(middles[i]) for i in at), float(pixels[-1] / finite) if high == full else 0.0, 1 - finite / whole,
        edges, pixels,
    )  # fmt: skip


def light_of(
    source: ScanSource, found: list[KindStatistics], photons_per_count: float, material: str | None
) -> list[str]:
    """Sentences: photons a pixel, and the dose of all views where pixel size and energy are known.

    Args:
        photons_per_count: photons at the sample; the user knows the detector.

    Raises:
        ConfigError: there are no flats, or pixel size or energy are missing.
    """
    by_kind = {each.kind: each for each in found}
    flats = by_kind.get(FrameKind.FLAT)
    if flats is None or FrameKind.DARK not in by_kind:
        raise ConfigError(f"{source.path} has no darks and flats, which tell the light.")
    photons, views = (flats.mean - by_kind[FrameKind.DARK].mean) * photons_per_count, by_kind[FrameKind.PROJECTION].of
    seconds = (float(np.nanmean(source.exposures[source.image_key == kind])) for kind in (0, 1))
    scaled = photons * next(seconds) / next(seconds)
    scaled = scaled if np.isfinite(scaled) else photons
    said = [f"{scaled:.4g} photons a pixel and view in the open beam, {scaled * views:.4g} in {views} views"]
    if material is not None:
        if source.cone is not None:
            raise ConfigError(f"{source.path} is of a cone; --dose-in is for a parallel beam of one energy.")
        if source.pixel_size_mm is None or source.energy_kev is None:
            missing = "pixel size" if source.pixel_size_mm is None else "energy"
            raise ConfigError(f"--dose-in needs pixel size and energy; {source.path} does not state its {missing}.")
        try:
            gray = absorbed_dose(material, source.energy_kev, scaled * views / source.pixel_size_mm**2)
        except ValueError as error:
            raise ConfigError(f"--dose-in {material}: {error}.") from error
        said.append(f"{gray:.4g} Gy absorbed in {material} at {source.energy_kev:g} keV, at its surface, by all views")
    return said


def table(found: list[KindStatistics]) -> list[tuple[str, ...]]:
    """Head, and a row for each kind."""
    percent = tuple(f"{p:g} %" for p in PERCENT)
    head = ("kind", "frames", "min", *percent, "max", "mean", "std", "saturated", "not finite")
    rows = [
        (
            each.kind.name.lower(), f"{each.frames} of {each.of}",
            *(f"{v:.6g}" for v in (each.minimum, *each.percentiles, each.maximum, each.mean, each.deviation)),
            f"{100 * each.saturated:.2g} %", f"{100 * each.not_finite:.2g} %",
        )
        for each in found
    ]  # fmt: skip
    return [head, *rows]


def histograms(found: list[KindStatistics]) -> bytes:
    """Pixels against their values, a curve a kind, as PNG; at most 400 bins each."""
    figure = Figure(figsize=(WIDTH, 4.2), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    for each in found:
        step = max(1, -(-each.pixels.size // 400))
        starts = np.arange(0, each.pixels.size, step)
        edges = np.append(each.edges[starts], each.edges[-1])
        shares = np.add.reduceat(each.pixels, starts) / max(each.pixels.sum(), 1) / np.diff(edges)
        axes.stairs(shares, edges, label=f"{each.kind.name.lower()} ({each.frames} of {each.of} frames)")
    axes.set(xlabel="value of a pixel, as stored", ylabel="share of pixels per unit", yscale="log")
    axes.legend(fontsize=8)
    return png(figure)
