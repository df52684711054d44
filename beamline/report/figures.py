"""Pictures for reports: arrays to PNG bytes, with labelled axes, units and a stated grey window."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from beamline.core.quantities import VoxelKind
from recon.base.geometry import Geometry
from recon.base.greys import matter_window
from recon.base.volume import Grid, Volume
from recon.voxels.view_weights import Wedge

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

GreyWindow = tuple[float, float]
DPI = 110
_FINEST = 300  # pixels an inch, of slices, which have a pixel a voxel as far as that goes
WIDTH = 8.6  # inches; the report's column
_PROFILE = 16.0  # voxels to either side of an edge
_LEFT, _TOP, _BELOW, _GAP, BAR = 0.95, 0.35, 0.5, 0.15, 1.0  # inches around panels, between them, of a bar of colours
_BESIDE = 0.5  # inches, of small labels
_BESIDE_BAR = WIDTH - _LEFT - BAR
_LOOKED_AT = 256  # slices along each axis, at least, of a volume that has more
_THIN = 0.06  # an image with a smaller ratio of height to width is stretched


def grey_window(arrays: Sequence[NDArray[np.floating]], low: float = 1.0, high: float = 99.5) -> GreyWindow:
    """One range of grey values for all `arrays`: percentiles of all their values."""
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
    """Draw an image, row 0 at the top, in the colours of a window; a pixel is a square unless `stretched`.

    Args:
        extent: edges left, right, bottom, top; None: pixels.
        colours: a colour map in place of greys.
    """
    return axes.imshow(
        image, cmap=colours, vmin=window[0], vmax=window[1], extent=extent, aspect="auto" if stretched else "equal",
        interpolation="nearest",
    )  # fmt: skip


def finish(axes: Axes, across: str, down: str, title: str = "", size: float = 10.0, grid: bool = False) -> None:
    """Axis labels of `size` points, a title, a legend of what has a label, and the lines of a `grid` under curves."""
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
    ends = [(at - n / 2 * grid.voxel_size, at + n / 2 * grid.voxel_size)
            for at, n in zip(grid.centre, grid.shape, strict=True)]  # fmt: skip
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
    """Draw a slice with its axes, labels of `size` points; `window`, `colours`: as of `show_image`."""
    from matplotlib.ticker import MaxNLocator

    across, down, edges = plane
    shown = show_image(axes, image, window, edges, image.shape[0] < _THIN * image.shape[1], colours)
    axes.xaxis.set_major_locator(MaxNLocator(5, prune="both"))  # the next panel's ticks begin at its edge
    finish(axes, across, down, title, size)
    return shown


def orthogonal_cuts(volume: Volume, at: Sequence[int]) -> list[NDArray[np.float32]]:
    """The slices across z, y and x through a voxel."""
    return [volume.data[(slice(None),) * i + (place,)] for i, place in enumerate(at)]


def draw_cuts(
    row: Sequence[Axes], volume: Volume, at: Sequence[int], unit: str, name: str, window: GreyWindow, colours: str
) -> AxesImage:
    """Draw the orthogonal slices through a voxel side by side, the first one under a name."""
    centres, cuts = volume.grid.coordinates(), orthogonal_cuts(volume, at)
    for i, (axes, image, plane) in enumerate(zip(row, cuts, planes(volume.grid, unit), strict=True)):
        place = f"{'zyx'[i]} = {centres[i][at[i]]:.3g} {unit}"
        shown = draw_slice(axes, image, plane, f"{name}, {place}" if name and i == 0 else place, window, colours, 7)
    return shown


def projection(data: NDArray[np.float32], geometry: Geometry, view: int, unit: str) -> bytes:
    """One corrected view [row, col] with the rotation axis, as the camera sees it: row 0 at the top, z downwards."""
    rows, cols = geometry.detector_shape
    pitch = geometry.sample_pitch
    left, right = -0.5 - geometry.axis_col, cols - 0.5 - geometry.axis_col
    thin = rows < _THIN * cols
    height = float(np.clip(_BESIDE_BAR * rows / cols, 1.6, 6.0))
    width = _BESIDE_BAR if thin else min(_BESIDE_BAR, height * cols / rows)
    figure, ((axes,),) = panels([width], [height], right=BAR)
    edges = left * pitch, right * pitch, rows / 2 * pitch, -rows / 2 * pitch
    image = show_image(axes, data[view], grey_window([data[view]]), edges, stretched=thin)
    axes.axvline(0.0, color="tab:orange", lw=1, ls="--", label="rotation axis")
    finish(axes, f"u ({unit})", downwards("z", unit), f"View at {np.degrees(geometry.angles[view]):.2f}°")
    add_bar(figure, image, "line integral")
    return png(figure)


def sinogram(data: NDArray[np.float32], geometry: Geometry, row: int) -> bytes:
    """All views of one detector row, in order of angle."""
    from matplotlib.ticker import MaxNLocator

    order = np.argsort(geometry.angles, kind="stable")
    angles = np.degrees(geometry.angles[order])
    image_rows = data[order, row]
    figure, ((axes,),) = panels([_BESIDE_BAR], [3.4], right=BAR)
    image = show_image(axes, image_rows, grey_window([image_rows]), stretched=True)
    axes.axvline(geometry.axis_col, color="tab:orange", lw=1, ls="--", label="rotation axis")
    ticks = MaxNLocator(7, steps=[1, 1.5, 2, 3, 4.5, 6, 9, 10]).tick_values(angles[0], angles[-1])
    ticks = ticks[(ticks >= angles[0]) & (ticks <= angles[-1])]
    axes.set_yticks(np.interp(ticks, angles, np.arange(len(order))), [f"{angle:g}" for angle in ticks])
    finish(axes, "column (px)", "angle (°)", f"Sinogram of row {row}, {len(order)} views")
    add_bar(figure, image, "line integral")
    return png(figure)


def downwards(axis: str, unit: str) -> str:
    """Label of a vertical axis whose numbers grow downwards: the text is turned, so that its arrow points down."""
    return f"← {axis} ({unit})"


def orthogonal_slices(
    volumes: Mapping[str, Volume],
    unit: str,
    kind: VoxelKind = VoxelKind.ATTENUATION,
) -> bytes:
    """A row of three orthogonal slices through each volume, in one grey window; y and z downwards, as image viewers
    show them.

    They intersect at the centre of mass of the bright voxels of the last volume.

    Args:
        volumes: by name, all on the same grid.
        unit: of length.
        kind: what the voxels are.
    """
    first = next(iter(volumes.values())).grid
    nz, ny, nx = first.shape
    at = bright_centre(list(volumes.values())[-1].data)
    greys = matter_window(*(image for volume in volumes.values() for image in orthogonal_cuts(volume, at)))
    height = max(ny / nx, nz / nx, nz / ny, _THIN)
    column = min((WIDTH - _BESIDE - BAR - 2 * _BESIDE) / 3, 12 / (height * len(volumes)))
    down = [column * height] * len(volumes)
    figure, rows = panels([column] * 3, down, dpi_for(nx, column), left=_BESIDE, gap=_BESIDE, right=BAR)
    for row, (name, volume) in zip(rows, volumes.items(), strict=True):
        shown = draw_cuts(row, volume, at, unit, name, greys, "gray")
    add_bar(figure, shown, kind.label(unit), size=7)
    return png(figure)


def differences(volumes: Mapping[str, Volume], unit: str, kind: VoxelKind = VoxelKind.ATTENUATION) -> bytes:
    """Where each volume is denser (red) or less dense (blue) than the first one, in the slice z of
    `orthogonal_slices`."""
    (first, reference), *others = volumes.items()
    z = bright_centre(list(volumes.values())[-1].data)[0]
    images = [volume.data[z] - reference.data[z] for _, volume in others]
    reach = max(-grey_window(images)[0], grey_window(images)[1], 1e-12)
    (_, ny, nx), plane = reference.grid.shape, planes(reference.grid, unit)[0]
    column = min((WIDTH - 1.2) / len(images), 5.4)
    figure = new_figure((1.2 + column * len(images), 0.9 + column * ny / nx), dpi_for(nx, column))
    for axes, image, (name, _) in zip(figure.subplots(1, len(images), squeeze=False)[0], images, others, strict=True):
        shown = draw_slice(axes, image, plane, f"{name} − {first}", (-reach, reach), "RdBu_r", 9)
    figure.colorbar(shown, ax=figure.axes, label=f"difference ({kind.unit(unit)})", shrink=0.8, pad=0.02)
    return png(figure)


def profile_and_values(volumes: Mapping[str, Volume], unit: str, kind: VoxelKind = VoxelKind.ATTENUATION) -> bytes:
    """Profile of each volume through the sharpest edge of the last one, and a histogram of its values.

    The line lies in the slice z of `orthogonal_slices`, along the gradient where that is largest after a blur of a
    voxel. So single noisy voxels are no edges.
    """
    from matplotlib.ticker import MaxNLocator, NullFormatter

    last = list(volumes.values())[-1].data
    z = bright_centre(last)[0]
    smooth = np.pad(ndimage.gaussian_filter(last[z].astype(np.float64), 1.0), 1, mode="edge")
    down, across = (part[1:-1, 1:-1] for part in np.gradient(smooth))
    y, x = np.unravel_index(int(np.argmax(np.hypot(down, across))), down.shape)
    angle = math.atan2(down[y, x], across[y, x])
    t = np.arange(-_PROFILE, _PROFILE + 0.25, 0.5)
    figure, ((left, right),) = panels([3.27, 3.27], [2.35], gap=_LEFT)
    for name, volume in volumes.items():
        at = (y + t * math.sin(angle), x + t * math.cos(angle))
        line = ndimage.map_coordinates(volume.data[z], at, order=1, mode="constant", cval=np.nan)
        left.plot(t * volume.grid.voxel_size, line, lw=1.2, label=name)
        few = volume.data[tuple(slice(None, None, max(1, n // _LOOKED_AT)) for n in volume.data.shape)]
        low, high = grey_window([few], 0.05, 99.95)
        count, edges = np.histogram(few, bins=120, range=(low, high))
        right.stairs(count / few.size, edges, lw=1.2, label=name)
    left.xaxis.set_major_locator(MaxNLocator(5))
    right.set_yscale("log")
    right.yaxis.set_major_formatter("{x:g}")  # powers set as formulas take as long as the rest
    right.yaxis.set_minor_formatter(NullFormatter())  # which ticks of a decade to name takes long, and none is named
    edge = f"Edge at y = {y}, x = {x} of slice {z} (voxels)"
    finish(left, f"along the line ({unit})", kind.label(unit), edge, 9, grid=True)
    finish(right, kind.label(unit), "share of voxels", "Values", 9, grid=True)
    return png(figure)


def significance(image: NDArray[np.float32], grid: Grid, at: int, unit: str) -> bytes:
    """A slice [y, x] of the residual's back-projection in units of its noise; `at` is its number in the volume."""
    return _map(image, grid, unit, f"Slice {at}", "standard deviations of the noise", (-8.0, 8.0), "RdBu_r")


def stray_mass(image: NDArray[np.float32], grid: Grid, unit: str, kind: VoxelKind = VoxelKind.ATTENUATION) -> bytes:
    """The map [y, x] of density in empty voxels."""
    window, title = (float(np.min(image)), float(np.max(image))), "Highest density where views show nothing"
    return _map(image, grid, unit, title, kind.label(unit), window, "magma")


def _map(
    image: NDArray[np.float32], grid: Grid, unit: str, title: str, label: str, window: GreyWindow, colours: str
) -> bytes:
    """An image [y, x] of a slice of the grid, with a bar of its colours."""
    figure, axes = one_panel(5.4, 6.4)
    drawn = draw_slice(axes, image, planes(grid, unit)[0], title, window, colours)
    figure.colorbar(drawn, ax=axes, label=label, pad=0.02)
    return png(figure)


def wedges(volume: Volume, unseen: Sequence[Wedge], unit: str) -> bytes:
    """A slice through the bright voxels, with the directions of missing rays as sectors about the axis."""
    from matplotlib.patches import Wedge as Sector

    at, grid = bright_centre(volume.data)[0], volume.grid
    figure, axes = one_panel(5.4, 6.4)
    image, title = volume.data[at], f"Rays that no view shows, slice {at}"
    draw_slice(axes, image, planes(grid, unit)[0], title, matter_window(image))
    radius = 0.48 * grid.shape[2] * grid.voxel_size
    for wedge in unseen:
        first, last = wedge.rays
        for turn in (0, 180):  # a ray runs both ways
            sector = Sector((0, 0), radius, first + turn, last + turn, facecolor=("tab:orange", 0.08))
            sector.set(edgecolor="tab:orange", linewidth=1.2)
            axes.add_patch(sector)
    return png(figure)


def error_bars(volume: Volume, deviation: Volume, unit: str, kind: VoxelKind = VoxelKind.ATTENUATION) -> bytes:
    """A slice through the bright voxels, and its standard deviation, each with its colour bar and a scale bar."""
    at, grid = bright_centre(volume.data)[0], volume.grid
    figure = new_figure((WIDTH, 4.4), dpi_for(grid.shape[2], WIDTH / 2.4))
    length = round_length(grid.shape[2] * grid.voxel_size / 5)
    panels = (
        (volume.data[at], kind.value, "gray", matter_window(volume.data[at])),
        (deviation.data[at], "standard deviation", "magma", grey_window([deviation.data[at]], 0.5, 99.5)),
    )
    for axes, (image, label, colours, window) in zip(figure.subplots(1, 2), panels, strict=True):
        drawn = draw_slice(axes, image, planes(grid, unit)[0], f"Slice {at}", window, colours)
        left, _, _, top = drawn.get_extent()
        across, down = [left + length / 4, left + 5 * length / 4], top + length / 4
        axes.plot(across, [down, down], color="white", lw=3, solid_capstyle="butt")
        axes.text(across[0], down + length / 8, f"{length:g} {unit}", color="white", fontsize=8, va="top")
        figure.colorbar(drawn, ax=axes, label=f"{label} ({kind.unit(unit)})", shrink=0.8)
    return png(figure)


def round_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that does not exceed the length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(n for n in (1, 2, 5) if n * power <= length * (1 + 1e-9)))


def axis_curve(candidates: NDArray[np.float64], curve: NDArray[np.float64], value: float, confident: bool) -> bytes:
    """The mismatch of the views against the candidate columns of the rotation axis, with the chosen one."""
    figure, ((axes,),) = panels([WIDTH - _LEFT - _GAP], [1.95])
    axes.plot(candidates, curve, color="0.25", lw=1.2)
    axes.axvline(value, color="tab:orange", lw=1.2, ls="--", label=f"axis {value:.2f} px")
    title = "Rotation axis: " + ("a clear optimum" if confident else "NOT a clear optimum")
    finish(axes, "axis candidate (column, px)", "mismatch", title, grid=True)
    return png(figure)


def pose_curves(
    angles_deg: NDArray[np.float64], shifts: NDArray[np.float64], turns_deg: NDArray[np.float64], unit: str
) -> bytes:
    """Displacement (col, row) in `unit`, and roll and tilt in degrees, of the views [view, 2] against their angle."""
    curves = [(shifts, unit, ("along the columns", "along the rows")), (turns_deg, "degrees", ("roll", "tilt"))]
    shown = [curve for curve in curves if curve[0].any()]
    figure = new_figure((WIDTH, 2.4 * len(shown)))
    order = np.argsort(angles_deg, kind="stable")
    for axes, (values, label, names) in zip(np.ravel(figure.subplots(len(shown), sharex=True)), shown, strict=True):
        for column, name in enumerate(names):
            axes.plot(angles_deg[order], values[order, column], lw=1.0, marker=".", ms=2, label=name)
        finish(axes, "angle (degrees)", label, grid=True)
    return png(figure)


def bright_centre(data: NDArray[np.float32]) -> tuple[int, int, int]:
    """[z, y, x] of the centre of mass of the voxels brighter than half the grey window; the middle if none are."""
    steps = [max(1, n // _LOOKED_AT) for n in data.shape]
    few = data[:: steps[0], :: steps[1], :: steps[2]]
    low, high = grey_window([few[::2, ::2, ::2]])
    marginals = [np.zeros(n) for n in few.shape]
    for k, image in enumerate(few):  # a copy of all slices would be as large as they are
        bright = np.clip(image - (low + high) / 2, 0, high - low)
        marginals[0][k] = bright.sum(dtype=np.float64)
        marginals[1] += bright.sum(axis=1, dtype=np.float64)
        marginals[2] += bright.sum(axis=0, dtype=np.float64)
    total = float(marginals[0].sum())
    if total == 0:
        return data.shape[0] // 2, data.shape[1] // 2, data.shape[2] // 2
    centre = (step * float(m @ np.arange(m.size)) / total for step, m in zip(steps, marginals, strict=True))
    return tuple(round(at) for at in centre)


def dpi_for(voxels: int, inches: float) -> float:
    """Pixels an inch that show every voxel of a row of them."""
    return float(np.clip(voxels / inches, DPI, _FINEST))


def new_figure(size: tuple[float, float], dpi: float = DPI, constrained: bool = True) -> Figure:
    """A figure of this width and height, inches; `constrained`: panels make room for their labels."""
    from matplotlib.figure import Figure

    return Figure(figsize=size, dpi=dpi, layout="constrained" if constrained else None)


def panels(
    across: Sequence[float],
    down: Sequence[float],
    dpi: float = DPI,
    *,
    left: float = _LEFT,
    gap: float = _GAP,
    right: float = _GAP,
) -> tuple[Figure, list[list[Axes]]]:
    """A figure with a fixed grid of panels [row][column], with equal room for their labels.

    A layout that measures labels takes as long as all that is drawn.

    Args:
        across, down: widths and heights of the panels, inches.
        left, gap, right: beside the first column, between columns, and beside the last, inches; BAR: room for a bar.
    """
    width = left + sum(across) + gap * (len(across) - 1) + right
    height = _TOP + sum(down) + _BELOW * len(down)
    figure = new_figure((width, height), dpi, constrained=False)
    lefts = [left + sum(across[:j]) + gap * j for j in range(len(across))]
    bottoms = [height - _TOP - sum(down[: i + 1]) - _BELOW * i for i in range(len(down))]
    return figure, [
        [figure.add_axes((at / width, bottom / height, wide / width, high / height))
         for at, wide in zip(lefts, across, strict=True)]
        for bottom, high in zip(bottoms, down, strict=True)
    ]  # fmt: skip


def add_bar(figure: Figure, image: AxesImage, label: str, size: float = 10) -> None:
    """A bar of the colours of an image, in the room on the right of `panels`; labels of `size` points."""
    width, height = figure.get_size_inches()
    high = 0.8 * (height - _TOP - _BELOW)
    place = (width - BAR + 0.12) / width, (_BELOW + high / 8) / height, 0.16 / width, high / height
    bar = figure.colorbar(image, cax=figure.add_axes(place))
    bar.set_label(label, fontsize=size)
    bar.ax.tick_params(labelsize=size)


def one_panel(height: float, width: float = WIDTH) -> tuple[Figure, Axes]:
    """A figure of one panel, inches."""
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
