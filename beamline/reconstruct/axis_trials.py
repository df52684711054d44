"""Axis trials: one slice by each of several rotation axes, scored, as a picture; nothing else is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.core.events import Done, Sink
from beamline.core.files import refuse_existing, write_whole
from beamline.core.sinks import Warnings
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import check_axis, cone_of, rows_of
from beamline.reconstruct.options import ReconOptions
from beamline.report.figures import grey_window, png, show_grey
from drivers.base.clock import Clock
from recon.base.volume import Grid
from recon.voxels.direct import direct

_MOST, _SHOWN = 400, 24


@dataclass(frozen=True)
class AxisRange:
    """Rotation axes to try: columns of the full detector from `first` to `last`, `step` apart."""

    first: float
    last: float
    step: float

    def __post_init__(self) -> None:
        if not (self.step > 0 and self.first < self.last < float("inf") and self.first > -float("inf")):
            raise ValueError("expected FIRST < LAST and a STEP above 0, in columns")
        if (n := self.columns.size) > _MOST:
            raise ValueError(f"{n} axes are more than {_MOST}: give a larger STEP")

    @property
    def columns(self) -> NDArray[np.float64]:
        return self.first + self.step * np.arange(np.floor((self.last - self.first) / self.step + 1e-9) + 1)


def try_axes(
    options: ReconOptions, wanted: AxisRange, path: Path, sink: Sink, clock: Clock, progress: Callable[[int, int], None]
) -> None:
    """Reconstruct the middle of the chosen rows by FBP with each axis and write the sheet; `done` has the scores.

    The score is the share of a slice below 0 within the circle that all views see. A wrong axis takes away beside edges
    what it adds elsewhere (Donath et al. 2006, J. Opt. Soc. Am. A 23, 1048, integral of negativity).

    Raises:
        ConfigError, DataError: with nothing written.
    """
    refuse_existing(path)
    columns = wanted.columns
    with options.source.open() as source:
        selection = options.selection
        if cone_of(source, selection) is not None:
            raise ConfigError("--axis try is for a parallel beam; of a cone, reconstruct with some axes and compare.")
        for col in (columns[0], columns[-1]):
            check_axis(source, float(col))
        rows, n = rows_of(source, selection), selection.binning
        first = rows.start + (rows.stop - rows.start) // n // 2 * n
        selection = replace(selection, rows=(first, first + n), axis_col=float(columns[columns.size // 2]))
        prepared = prepare_projections(source, selection, Warnings(sink, clock))
        data = prepared.projections.data
        grid = Grid.matching(prepared.geometry)
        inside = _circle(grid.shape[1:])
        kept = set(np.unique(np.linspace(0, columns.size - 1, min(columns.size, _SHOWN)).astype(int)).tolist())
        trials = []
        for i, col in enumerate(columns.tolist()):
            geometry = replace(prepared.geometry, axis_col=(col - (n - 1) / 2) / n)
            image = direct(data, geometry, grid, "hann")[0]
            part = image[inside]
            score = -float(np.minimum(part, 0).sum()) / max(float(np.abs(part).sum()), 1e-30)
            trials.append(AxisTrial(col, score, image if i in kept else None))
            progress(i + 1, columns.size)
    picture = axis_sheet(trials, f"{source.path.name}, row {first}")
    write_whole(path, picture)
    best = min(trials, key=lambda trial: trial.score)
    if best in (trials[0], trials[-1]):
        Warnings(sink, clock)(f"The lowest score is at the end of the range, column {best.col:g}: try further.")
    scores = {f"{trial.col:g}": trial.score for trial in trials}
    sink(Done({"output": str(path), "axis_col": best.col, "scores": scores}, time=clock.now()))


def _circle(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Pixels of a slice inside the circle that touches its sides."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    return np.asarray(np.hypot(y[:, None], x) < min(shape) / 2 - 1)


_WIDTH, _DPI, _COLUMNS = 8.6, 110, 4
_CROP = 200  # voxels: where slices are larger, the part that changes most


@dataclass(frozen=True, eq=False)
class AxisTrial:
    """One slice by one rotation axis.

    Attributes:
        col: of the axis, in the full detector.
        score: matter below zero, as a share; lower is better.
        image: [y, x], of every trial on the same grid; None: not kept.
    """

    col: float
    score: float
    image: NDArray[np.float32] | None


def axis_sheet(trials: list[AxisTrial], title: str) -> bytes:
    """The curve of scores above the slices that were kept, as PNG; the best is marked."""
    shown = [(trial, trial.image) for trial in trials if trial.image is not None]
    best = min(trials, key=lambda trial: trial.score)
    part = _changes_most([image for _, image in shown])
    images = [image[part] for _, image in shown]
    window, down = grey_window(images, 0.5, 99.5), -(-len(images) // _COLUMNS)
    tall, wide = images[0].shape
    height = _WIDTH / _COLUMNS * tall / wide + 0.22
    figure = Figure(figsize=(_WIDTH, 2.4 + height * down), dpi=_DPI, layout="constrained")
    panels = figure.add_gridspec(1 + down, _COLUMNS, height_ratios=[2.4, *[height] * down])
    curve = figure.add_subplot(panels[0, :])
    curve.plot([trial.col for trial in trials], [trial.score for trial in trials], "o-", ms=3, lw=1)
    curve.plot([best.col], [best.score], "o", color="tab:red", ms=7, label=f"lowest: {best.col:g}")
    curve.set(xlabel="rotation axis (column)", ylabel="share below 0 (lower is better)", title=title)
    curve.legend(fontsize=8)
    for n, ((trial, _), image) in enumerate(zip(shown, images, strict=True)):
        axes = figure.add_subplot(panels[1 + n // _COLUMNS, n % _COLUMNS])
        show_grey(axes, image, window)
        axes.set(xticks=[], yticks=[])
        if n == 0:
            axes.set(xlabel="x →", ylabel="← y")
        axes.set_title(f"{trial.col:g}", fontsize=8, color="tab:red" if trial is best else "black")
    return png(figure)


def _changes_most(images: list[NDArray[np.float32]]) -> tuple[slice, slice]:
    """The square of the slices in which the axis changes most."""
    shape = images[0].shape
    spread = np.ptp(np.stack(images), axis=0)
    step = _CROP // 2
    corners = [(y, x) for y in range(0, max(1, shape[0] - step), step) for x in range(0, max(1, shape[1] - step), step)]
    corner = max(corners, key=lambda at: float(spread[at[0] : at[0] + _CROP, at[1] : at[1] + _CROP].sum()))
    first = [min(start, max(0, size - _CROP)) for start, size in zip(corner, shape, strict=True)]
    return slice(first[0], first[0] + _CROP), slice(first[1], first[1] + _CROP)
