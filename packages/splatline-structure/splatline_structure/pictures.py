"""Pictures of a structure: a slice with its labels, curves with bands, and bars of what limits each interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.report.figures import WIDTH, draw_slice, finish, new_figure, planes, png
from beamline.report.html import Picture
from recon import Grid
from splatline_structure.intervals import CAUSES, Interval, MeasuredStructure
from splatline_structure.materials import F32
from splatline_structure.volumes import ReadSlices


def pictures_of(measured: MeasuredStructure, volume: F32, grid: Grid, read: ReadSlices) -> list[Picture]:
    """All pictures of a page; the picture of sizes only if a particle is whole."""
    band = (
        " The band spans three curves: from all projections, and from each half of the projections."
        if measured.parts
        else ""
    )
    shown = [
        Picture(
            "Materials",
            "The middle slice: the volume, the materials (red: voxels of uncertain material), and the particles.",
            slices(measured, volume, grid),
        )
    ]
    if not measured.structure.particles.cut.all():
        shown.append(
            Picture(
                "Sizes",
                "Fraction of the total volume of the particles that is in particles up to each diameter. Particles "
                "that the edge of the box cuts are left out. Horizontal lines show the intervals of the diameters "
                f"at 10, 50 and 90 % of the volume.{band}",
                sizes(measured),
            )
        )
    return [
        *shown,
        Picture(
            "Profiles",
            "Fraction of the particles' material in each slice, and at each distance from the "
            f"middle.{' Grey lines: all slices.' if read.limit_sentence else ''}{band}",
            profiles(measured, grid, read),
        ),
        Picture(
            "What limits the intervals",
            "Half-width of the intervals from each cause. Numbers that could not be determined are left out.",
            causes(measured.intervals),
        ),
    ]


def slices(measured: MeasuredStructure, volume: F32, grid: Grid) -> bytes:
    """The middle slice, next to its labels and its particles."""
    figure = new_figure((WIDTH, WIDTH / 3 * grid.shape[1] / grid.shape[2] + 0.9))
    middle_slice, levels = grid.shape[0] // 2, measured.materials.levels
    plane, window = planes(grid, "mm")[0], (float(levels[0]), float(levels[-1]))
    volume_axes, middle, right = np.ravel(figure.subplots(1, 3, sharex=True, sharey=True))
    shown = draw_slice(volume_axes, volume[middle_slice], plane, "volume", window, size=7)
    labels = measured.structure.labels[middle_slice].astype(np.float32)
    draw_slice(middle, labels, plane, "materials", (0.0, max(float(len(levels) - 1), 1.0)), size=7)
    unsure = np.zeros((*labels.shape, 4))
    unsure[measured.unsure[middle_slice]] = (1, 0.1, 0.1, 0.9)
    middle.imshow(unsure, extent=shown.get_extent(), interpolation="nearest")
    numbers = measured.structure.numbered[middle_slice]
    draw_slice(
        right, np.where(numbers > 0, numbers * 7 % 20 + 1, 0), plane, "particles", (0.0, 20.0), "nipy_spectral", 7
    )
    for axes in (middle, right):
        axes.label_outer()
    return png(figure)


def sizes(measured: MeasuredStructure) -> bytes:
    """Cumulative volume of whole particles over diameter, with the intervals of the quantiles."""
    figure = new_figure((WIDTH, 3.2))
    axes = figure.subplots()
    whole = [each.particles.diameter[~each.particles.cut] for each in (measured.structure, *measured.parts)]
    diameters = np.linspace(0, max(float(each.max()) for each in whole if each.size), 60)
    _banded(
        axes,
        diameters,
        [np.array([(d[d <= x] ** 3).sum() for x in diameters]) / max(float((d**3).sum()), 1e-30) for d in whole],
    )
    shares = {percent / 100: measured.intervals[f"size_{percent}"] for percent in (10, 50, 90)}
    sure = {share: each for share, each in shares.items() if not each.why_not}
    axes.hlines([*sure], [each.low for each in sure.values()], [each.high for each in sure.values()], "C1")
    finish(axes, "equivalent diameter (µm)", "fraction of the volume", f"{whole[0].size} whole particles", grid=True)
    return png(figure)


def profiles(measured: MeasuredStructure, grid: Grid, read: ReadSlices) -> bytes:
    """The fraction of the particles' material along z (in grey: all slices), and in rings around the middle."""
    structures = [measured.structure, *measured.parts]
    figure = new_figure((WIDTH, 2.8))
    fraction_axes, right = np.ravel(figure.subplots(1, 2, sharey=True))
    z = grid.coordinates()[0]
    if measured.along_all is not None:
        all_z = z[0] + grid.spacing[0] * (np.arange(read.asked.start, read.asked.stop) - read.slices.start)
        fraction_axes.plot(all_z, measured.along_all, color="0.6")
    _banded(fraction_axes, z, [each.along_z for each in structures])
    finish(fraction_axes, "z (mm)", "fraction", grid=True)
    _banded(right, structures[0].radial[1], [each.radial[0] for each in structures])
    finish(right, "distance from the middle (µm)", "", grid=True)
    return png(figure)


def _banded(axes: Any, x: NDArray[np.floating], curves: Sequence[NDArray[np.floating]]) -> None:
    """Draw the first curve, and a band from the lowest to the highest of all curves."""
    axes.fill_between(x, np.min(curves, axis=0), np.max(curves, axis=0), alpha=0.3)
    axes.plot(x, curves[0])


def causes(intervals: Mapping[str, Interval]) -> bytes:
    """Bars of the half-widths from each cause, in per cent of the value, for numbers that are determined."""
    shown = {name: each for name, each in intervals.items() if not each.why_not and getattr(each, each.decides) > 0}
    figure = new_figure((WIDTH, 1.0 + 0.34 * max(len(shown), 1)))
    axes = figure.subplots()
    for k, cause in enumerate(CAUSES):
        widths = [100 * np.nan_to_num(getattr(each, cause)) / abs(each.value) for each in shown.values()]
        axes.barh(np.arange(len(shown)) + 0.2 * (k - 1.5), widths, 0.18, label=cause)
    axes.set_yticks(range(len(shown)), list(shown))
    axes.invert_yaxis()
    axes.set(xscale="log", xlim=(0.01, None))  # half-widths of fractions are some thousandths, of sizes some tenths
    finish(axes, "half-width (% of the value)", "", size=8)
    return png(figure)


def curves_of(series: Mapping[str, Sequence[Interval]], x: Sequence[float], across: str) -> bytes:
    """Numbers with their intervals, against time or number of projections."""
    figure = new_figure((WIDTH, 2.2 * len(series)))
    for axes, (name, each) in zip(
        np.ravel(figure.subplots(len(series), 1, sharex=True, squeeze=False)), series.items(), strict=True
    ):
        low, high, value = (
            np.array([getattr(interval, part) for interval in each], float) for part in ("low", "high", "value")
        )
        axes.fill_between(x, low, high, alpha=0.3)
        axes.plot(x, np.where(np.isfinite(value), value, np.nan), "o-")
        finish(axes, across, name, size=8, grid=True)
    return png(figure)
