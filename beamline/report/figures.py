"""Figures as PNG bytes: panels and images with labelled axes, units and a stated grey window."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recon.base.volume import Grid

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

GreyWindow = tuple[float, float]
DPI = 110
_FINEST = 300  # pixels per inch for slices, which have one pixel per voxel if possible
WIDTH = 8.6  # inches; width of the column of the report
LEFT, _TOP, _BELOW, GAP, BAR = 0.95, 0.35, 0.5, 0.15, 1.0  # inches around panels, between panels, and for a colour bar
LOOKED_AT = 256  # smallest number of slices along each axis, if the volume has more
THIN = 0.06  # an image with a smaller ratio of height to width is stretched


def grey_window(arrays: Sequence[NDArray[np.floating]], low: float = 1.0, high: float = 99.5) -> GreyWindow:
    """One range of grey values for all `arrays`, from percentiles of all of their values."""
    finite = np.concatenate([a[np.isfinite(a)].ravel() for a in arrays])
    if finite.size == 0:
        return 0.0, 1.0
    bottom, top = (float(v) for v in np.percentile(finite, [low, high]))
    return (bottom, top) if top > bottom else (bottom, bottom + 1.0)


def show_image(
    axes: Axes,
    image: NDArray[np.floating],
    window: GreyWindow,
    extent: tuple[float, float, float, float] | None = None,
    stretched: bool = False,
    colours: str = "gray",
) -> AxesImage:
    """Draw an image, row 0 at the top, in the colours of a window. A pixel is square unless `stretched` is True.

    Args:
        extent: edges left, right, bottom, top; None: pixels.
        colours: a colour map in place of greys.
    """
    return axes.imshow(
        image, cmap=colours, vmin=window[0], vmax=window[1], extent=extent, aspect="auto" if stretched else "equal",
        interpolation="nearest",
    )  # fmt: skip


def finish(axes: Axes, across: str, down: str, title: str = "", size: float = 10.0, grid: bool = False) -> None:
    """Add axis labels of `size` points, a title, and a legend if curves have labels. With `grid`, grid lines are drawn
    under the curves."""
    axes.set_xlabel(across, fontsize=size, labelpad=1)
    axes.set_ylabel(down, fontsize=size, labelpad=1)
    axes.set_title(title, fontsize=size + 1, pad=4)
    axes.tick_params(labelsize=size - 1)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)
    if grid:
        axes.grid(alpha=0.3)


Plane = tuple[str, str, tuple[float, float, float, float]]
"""Labels of the axes to the right and downwards of a slice, and its edges left, right, bottom, top."""


def planes(grid: Grid, unit: str) -> list[Plane]:
    """The planes of the slices across z, y and x."""
    ends = [(middle - n / 2 * grid.voxel_size, middle + n / 2 * grid.voxel_size)
            for middle, n in zip(grid.centre, grid.shape, strict=True)]  # fmt: skip
    return [
        (f"{'zyx'[across]} ({unit})", downwards("zyx"[down], unit), (*ends[across], *ends[down][::-1]))
        for down, across in ((1, 2), (0, 2), (0, 1))
    ]


def draw_slice(
    axes: Axes,
    image: NDArray[np.floating],
    plane: Plane,
    title: str,
    window: GreyWindow,
    colours: str = "gray",
    size: float = 10.0,
) -> AxesImage:
    """Draw a slice with its axes and labels of `size` points. `window` and `colours` are as for `show_image`."""
    from matplotlib.ticker import MaxNLocator

    across, down, edges = plane
    shown = show_image(axes, image, window, edges, image.shape[0] < THIN * image.shape[1], colours)
    axes.xaxis.set_major_locator(MaxNLocator(5, prune="both"))  # the ticks of the next panel begin at its edge
    finish(axes, across, down, title, size)
    return shown


def downwards(axis: str, unit: str) -> str:
    """Label of a vertical axis whose numbers grow downwards. The text is rotated so that its arrow points down."""
    return f"← {axis} ({unit})"


def round_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that does not exceed the length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(n for n in (1, 2, 5) if n * power <= length * (1 + 1e-9)))


def bright_centre(data: NDArray[np.float32]) -> tuple[int, int, int]:
    """[z, y, x] of the centre of mass of the voxels that are brighter than half the grey window. If there are none, the
    middle of the volume."""
    steps = [max(1, n // LOOKED_AT) for n in data.shape]
    few = data[:: steps[0], :: steps[1], :: steps[2]]
    low, high = grey_window([few[::2, ::2, ::2]])
    marginals = [np.zeros(n) for n in few.shape]
    for k, image in enumerate(few):  # slice by slice, because a copy of all slices would need as much memory again
        bright = np.clip(image - (low + high) / 2, 0, high - low)
        marginals[0][k] = bright.sum(dtype=np.float64)
        marginals[1] += bright.sum(axis=1, dtype=np.float64)
        marginals[2] += bright.sum(axis=0, dtype=np.float64)
    total = float(marginals[0].sum())
    if total == 0:
        return data.shape[0] // 2, data.shape[1] // 2, data.shape[2] // 2
    centre = (step * float(m @ np.arange(m.size)) / total for step, m in zip(steps, marginals, strict=True))
    return tuple(round(index) for index in centre)


def dpi_for(voxels: int, inches: float) -> float:
    """Resolution in pixels per inch at which every voxel in a row is visible."""
    return float(np.clip(voxels / inches, DPI, _FINEST))


def new_figure(size: tuple[float, float], dpi: float = DPI, constrained: bool = True) -> Figure:
    """A figure with this width and height in inches. `constrained`: panels make room for their labels."""
    from matplotlib.figure import Figure

    return Figure(figsize=size, dpi=dpi, layout="constrained" if constrained else None)


def panels(
    across: Sequence[float],
    down: Sequence[float],
    dpi: float = DPI,
    *,
    left: float = LEFT,
    gap: float = GAP,
    right: float = GAP,
) -> tuple[Figure, list[list[Axes]]]:
    """A figure with a fixed grid of panels [row, column], with equal room for their labels.

    The grid is fixed, because a layout that measures labels needs as much time as the whole drawing.

    Args:
        across, down: widths and heights of the panels in inches. left, gap, right: space in inches to the left of the
            first column, between columns, and to the right of the last column. BAR is the space for a colour bar.
    """
    width = left + sum(across) + gap * (len(across) - 1) + right
    height = _TOP + sum(down) + _BELOW * len(down)
    figure = new_figure((width, height), dpi, constrained=False)
    lefts = [left + sum(across[:j]) + gap * j for j in range(len(across))]
    bottoms = [height - _TOP - sum(down[: i + 1]) - _BELOW * i for i in range(len(down))]
    return figure, [
        [figure.add_axes((left_edge / width, bottom / height, wide / width, high / height))
         for left_edge, wide in zip(lefts, across, strict=True)]
        for bottom, high in zip(bottoms, down, strict=True)
    ]  # fmt: skip


def add_bar(figure: Figure, image: AxesImage, label: str, size: float = 10) -> None:
    """A colour bar for an image, in the space to the right of `panels`, with labels of `size` points."""
    width, height = figure.get_size_inches()
    high = 0.8 * (height - _TOP - _BELOW)
    place = (width - BAR + 0.12) / width, (_BELOW + high / 8) / height, 0.16 / width, high / height
    bar = figure.colorbar(image, cax=figure.add_axes(place))
    bar.set_label(label, fontsize=size)
    bar.ax.tick_params(labelsize=size)


def one_panel(height: float, width: float = WIDTH) -> tuple[Figure, Axes]:
    """A figure with a single panel; sizes are in inches."""
    figure = new_figure((width, height))
    return figure, figure.subplots()


def canvas(figure: Figure) -> FigureCanvasAgg:
    """The canvas of a figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    return FigureCanvasAgg(figure)


def png(figure: Figure) -> bytes:
    """The figure as PNG."""
    buffer = io.BytesIO()
    canvas(figure).print_png(buffer)
    return buffer.getvalue()
