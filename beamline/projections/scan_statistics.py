"""Statistics of the stored pixel values of a scan, by kind of frame, before any correction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.report.figures import finish, one_panel, png
from beamline.storage.readers.base import ScanSource, measured
from drivers.base.frame import FrameKind
from recon.base.views import spread
from recon.prep.matter import absorbed_dose

FRAMES = 64  # Frames of each kind that are examined, evenly spread.
PERCENT = (0.1, 1.0, 50.0, 99.0, 99.9)
_BINS = 2**16  # number of bins between the smallest and the largest real number; integers have one bin each


@dataclass(frozen=True, eq=False)
class KindStatistics:
    """Statistics of the pixel values of one kind of frame.

    Attributes:
        frames: number of frames that were examined, out of `n_all` frames.
        minimum, maximum, mean, deviation: statistics of all finite pixels of these frames.
        percentiles: percentiles at PERCENT, exact to one count; for real numbers, to 1/65536 of their range.
        saturated: fraction of the pixels that have the largest value of their type; 0 for real numbers.
        not_finite: fraction of the pixels that are not finite.
        absolute: sum of the absolute pixel values of a frame, mean over the frames.
        bin_edges, bin_counts: the histogram.
    """

    kind: FrameKind
    frames: int
    n_all: int
    minimum: float
    maximum: float
    mean: float
    deviation: float
    percentiles: tuple[float, ...]
    saturated: float
    not_finite: float
    bin_edges: NDArray[np.float64]
    bin_counts: NDArray[np.int64]
    absolute: float = 0.0


def statistics_of(
    source: ScanSource,
    progress: Callable[[int, int], None],
    kinds: Sequence[FrameKind] = (FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION),
) -> list[KindStatistics]:
    """Statistics of the frames of these kinds that the scan has. `progress` is called with frames read and their
    total."""
    chosen = {}
    for kind in kinds:
        rows = source.table.of_kind(kind)
        if rows.size:
            chosen[kind] = spread(rows, FRAMES), rows.size
    total, done = 2 * sum(rows.size for rows, _ in chosen.values()), 0

    def image(row: int) -> NDArray[Any]:
        nonlocal done
        done += 1
        progress(done, total)
        return measured(source.read([row]))[0]

    return [_of_kind(kind, rows, count, image, source.dtype) for kind, (rows, count) in chosen.items()]


def _of_kind(
    kind: FrameKind, rows: NDArray[np.intp], n_all: int, image: Callable[[int], NDArray[Any]], dtype: np.dtype[Any]
) -> KindStatistics:
    """Statistics from two passes over the frames. The first pass finds the range; the second makes the histogram, and
    moments about a value in the range.
    """
    low, high, n_finite, n_pixels = np.inf, -np.inf, 0, 0
    for row in map(int, rows):
        values = image(row)
        finite_values = values[np.isfinite(values)]
        n_finite, n_pixels = n_finite + finite_values.size, n_pixels + values.size
        if finite_values.size:
            low, high = min(low, float(finite_values.min())), max(high, float(finite_values.max()))
    if not n_finite:
        no_values = (np.nan,) * len(PERCENT)
        return KindStatistics(
            kind,
            rows.size,
            n_all,
            np.nan,
            np.nan,
            np.nan,
            np.nan,
            no_values,
            0.0,
            1.0,
            np.zeros(2),
            np.zeros(1, np.int64),
        )
    whole_numbers = dtype.kind in "iu" and high - low < 2**20
    edges = (
        np.arange(low - 0.5, high + 1) if whole_numbers else np.linspace(low, high if high > low else low + 1, _BINS)
    )
    pixels, total, squares, absolute = np.zeros(edges.size - 1, np.int64), 0.0, 0.0, 0.0
    for row in map(int, rows):
        finite_values = image(row)
        finite_values = finite_values[np.isfinite(finite_values)]
        above_low = finite_values.astype(np.float64) - low
        if whole_numbers:
            pixels += np.bincount(above_low.astype(np.int64), minlength=pixels.size)
        else:
            pixels += np.histogram(finite_values, edges)[0]
        total, squares = total + float(above_low.sum()), squares + float(above_low @ above_low)
        absolute += float(np.abs(above_low + low).sum()) / rows.size
    mean = total / n_finite
    cumulative = np.cumsum(pixels)
    bins = np.searchsorted(cumulative, np.array(PERCENT) / 100 * n_finite)
    middles = (edges[1:] + edges[:-1]) / 2
    full_scale = float(np.iinfo(dtype).max) if dtype.kind in "iu" else np.inf
    return KindStatistics(
        kind, rows.size, n_all, low, high, low + mean, float(np.sqrt(max(squares / n_finite - mean**2, 0.0))),
        tuple(float(middles[i]) for i in bins), float(pixels[-1] / n_finite) if high == full_scale else 0.0,
        1 - n_finite / n_pixels, edges, pixels, absolute,
    )  # fmt: skip


@dataclass(frozen=True)
class DoseRequest:
    """What the user states for the intensity and the dose: photons per count, and a material.

    Attributes:
        photons_per_count: X-ray photons at the sample per count.
        material: a name or formula for which the dose is computed; None: photons only.
    """

    photons_per_count: float
    material: str | None = None

    def refuse_impossible(self, source: ScanSource) -> None:
        """Raise the errors that can be found without reading a frame.

        Raises:
            ConfigError: there are no darks and flats, or the scan does not state what a dose needs.
        """
        if not source.table.has(FrameKind.DARK, FrameKind.FLAT):
            raise ConfigError(
                f"{source.path} has no darks and flats, which are needed to measure the intensity of the beam."
            )
        if self.material is not None:
            _gray(self.material, source, 0.0)


def _gray(material: str, source: ScanSource, photons: float) -> float:
    """Dose at the surface in Gy for this many photons per pixel. Raises ConfigError as
    `DoseRequest.refuse_impossible`.
    """
    if source.cone is not None:
        raise ConfigError(
            f"Omit --dose-in: this option is for a parallel monochromatic beam, and {source.path} is a cone-beam scan."
        )
    if source.pixel_size_mm is None or source.energy_kev is None:
        missing = "pixel size" if source.pixel_size_mm is None else "energy"
        raise ConfigError(f"--dose-in needs pixel size and energy; {source.path} does not state the {missing}.")
    height = source.pixel_size_mm if source.row_pitch_mm is None else source.row_pitch_mm
    try:
        return absorbed_dose(material, source.energy_kev, photons / (source.pixel_size_mm * height))
    except ValueError as error:
        raise ConfigError(f"--dose-in {material}: {error}.") from error


@dataclass(frozen=True)
class PhotonDose:
    """Photons and dose of one projection of a scan.

    Attributes:
        views: number of projections of the scan.
        photons: photons per pixel and projection in the open beam at the sample.
        gray: dose in Gy at the surface of the sample per projection; None: not requested.
        material: a text with the absorbing material and the energy.
    """

    views: int
    photons: float
    gray: float | None = None
    material: str = ""

    def in_words(self) -> list[str]:
        """Intensity and dose of all projections, as sentences."""
        each = f"{self.photons:.4g} photons per pixel and projection in the open beam"
        out = [f"{each}, {self.photons * self.views:.4g} in {self.views} projections"]
        if self.gray is not None:
            total_gray = self.gray * self.views
            out.append(f"{total_gray:.4g} Gy absorbed in {self.material}, at its surface, in all projections")
        return out


def photon_dose_of(source: ScanSource, statistics: list[KindStatistics], request: DoseRequest) -> PhotonDose:
    """Intensity and dose of a projection, from the statistics of flats and darks.

    Raises:
        ConfigError: as `DoseRequest.refuse_impossible`.
    """
    request.refuse_impossible(source)
    mean = {each.kind: each.mean for each in statistics}
    photons = (mean[FrameKind.FLAT] - mean[FrameKind.DARK]) * request.photons_per_count
    exposures = (source.table.exposures[source.table.of_kind(kind)] for kind in (FrameKind.PROJECTION, FrameKind.FLAT))
    known_exposures = [each[np.isfinite(each)] for each in exposures]
    if all(each.size for each in known_exposures):  # otherwise all frames are assumed to have the same exposure
        photons *= float(known_exposures[0].mean() / known_exposures[1].mean())
    photons *= source.frames_per_view
    views = source.table.views.size
    if request.material is None:
        return PhotonDose(views, photons)
    return PhotonDose(
        views, photons, _gray(request.material, source, photons), f"{request.material} at {source.energy_kev:g} keV"
    )


def table(statistics: list[KindStatistics]) -> list[tuple[str, ...]]:
    """The statistics as a table of texts: a header, and one row for each kind."""
    percent = tuple(f"{p:g} %" for p in PERCENT)
    head = ("kind", "frames", "min", *percent, "max", "mean", "std", "sum |v|", "saturated", "no data")
    rows = [
        (
            each.kind.name.lower(), f"{each.frames} of {each.n_all}",
            *(f"{v:.6g}" for v in (each.minimum, *each.percentiles, each.maximum, each.mean, each.deviation)),
            f"{each.absolute:.6g}", f"{100 * each.saturated:.2g} %", f"{100 * each.not_finite:.3g} %",
        )
        for each in statistics
    ]  # fmt: skip
    return [head, *rows]


def histograms(statistics: list[KindStatistics]) -> bytes:
    """Histograms of the pixel values, one curve for each kind, as PNG; at most 400 bins each."""
    figure, axes = one_panel(4.2)
    for each in statistics:
        step = max(1, -(-each.bin_counts.size // 400))
        starts = np.arange(0, each.bin_counts.size, step)
        edges = np.append(each.bin_edges[starts], each.bin_edges[-1])
        shares = np.add.reduceat(each.bin_counts, starts) / max(each.bin_counts.sum(), 1) / np.diff(edges)
        axes.stairs(shares, edges, label=f"{each.kind.name.lower()} ({each.frames} of {each.n_all} frames)")
    axes.set_yscale("log")
    finish(axes, "pixel value, as stored", "share of pixels per unit")
    return png(figure)
