"""Axis sheet: one slice by several rotation axes, and the score of each, to choose by eye."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beamline.report.figures import grey_window, png, show_grey

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
