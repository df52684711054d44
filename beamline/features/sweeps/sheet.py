"""Sheet of a sweep: the same part of each slice in one grey window, with the curve of the scores above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from beamline.features.sweeps.sweep import Scores, SweptSlice
from beamline.features.sweeps.values import SweptOption
from beamline.report.figures import WIDTH, new_figure, png, show_grey
from beamline.report.metrics import METRICS
from recon.base.greys import matter_window

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS, _CURVE = 4, 2.2  # pictures in a row; inches
_CROP = 200  # pixels a side: of larger slices the part is shown that changes most, in proportion to its values


def sweep_sheet(
    slices: Sequence[SweptSlice], scores: Scores | None, options: Sequence[SweptOption], title: str
) -> bytes:
    """The slices as PNG, y downwards. The best is framed in red, and those that chance does not tell from it in orange.

    Two options make a grid, the values of the second one side by side.
    """
    across = len(options[1].values) if len(options) > 1 else min(_COLUMNS, len(slices))
    down = -(-len(slices) // across)
    part = _changes_most([each.image for each in slices])
    images = [each.image[part] for each in slices]
    window = matter_window(*images)
    tall, wide = images[0].shape
    height = WIDTH / across * tall / wide + 0.42
    curve = _CURVE if scores is not None and len(options) == 1 else 0.0
    figure = new_figure((WIDTH, curve + height * down + 0.3))
    figure.suptitle(title, fontsize=9)
    panels = figure.add_gridspec(1 + down, across, height_ratios=[max(curve, 0.01), *[height] * down])
    if scores is not None and curve:
        _draw_curve(figure.add_subplot(panels[0, :]), slices, scores, options[0])
    for n, (each, image) in enumerate(zip(slices, images, strict=True)):
        axes = figure.add_subplot(panels[1 + n // across, n % across])
        show_grey(axes, image, window)
        axes.set(xticks=[], yticks=[])
        if n == 0:
            axes.set(xlabel="x →", ylabel="← y")
        colour = _colour(scores, n)
        words = each.label if scores is None else f"{each.label}\n{scores.shares[n]:.5g}"
        axes.set_title(words, fontsize=7, color=colour)
        for side in axes.spines.values():
            side.set(color=colour, linewidth=0.8 if colour == "black" else 2.5)
    return png(figure)


def _colour(scores: Scores | None, n: int) -> str:
    if scores is None or not scores.alike[n]:
        return "black"
    return "tab:red" if n == scores.best else "tab:orange"


def _draw_curve(axes: Axes, slices: Sequence[SweptSlice], scores: Scores, option: SweptOption) -> None:
    numbers = option.numbers[: len(slices)]
    at = numbers or range(len(slices))
    spread = min(numbers) > 0 and max(numbers) / min(numbers) > 30 if numbers else False
    axes.plot(at, scores.shares, "o-", ms=3, lw=1, color="tab:blue")
    for n, place in enumerate(at):
        if scores.alike[n]:
            axes.plot([place], [scores.shares[n]], "o", color=_colour(scores, n), ms=7)
    if numbers and spread:
        axes.set_xscale("log")
    if not numbers:
        axes.set_xticks(range(len(slices)), option.values[: len(slices)])
    axes.set_xlabel(option.name, fontsize=8)
    axes.set_ylabel(METRICS["residual_held_out"].label, fontsize=8)
    axes.tick_params(labelsize=7)


def _changes_most(images: Sequence[NDArray[np.float32]]) -> tuple[slice, slice]:
    """The square of the slices in which the options change most; all of them where they are small or differ in size."""
    shape = images[0].shape
    if max(shape) <= _CROP or any(image.shape != shape for image in images):
        return slice(None), slice(None)
    spread = np.ptp(np.stack(images), axis=0)
    total = np.pad(spread.cumsum(axis=0, dtype=np.float64).cumsum(axis=1), ((1, 0), (1, 0)))
    rows, cols = (min(_CROP, n) for n in shape)
    sums = total[rows:, cols:] - total[:-rows, cols:] - total[rows:, :-cols] + total[:-rows, :-cols]
    y, x = np.unravel_index(int(np.argmax(sums)), sums.shape)
    return slice(int(y), int(y) + rows), slice(int(x), int(x) + cols)
