"""Pictures of a report, as PNG bytes: projections, slices, and pictures of the quality of the volume."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from beamline.core.quantities import VoxelKind
from beamline.report.figures import (
    BAR,
    GAP,
    LEFT,
    LOOKED_AT,
    THIN,
    WIDTH,
    GreyWindow,
    add_bar,
    bright_centre,
    downwards,
    dpi_for,
    draw_slice,
    finish,
    grey_window,
    new_figure,
    one_panel,
    panels,
    planes,
    png,
    round_length,
    show_image,
)
from recon.base.geometry import Geometry
from recon.base.greys import material_window
from recon.base.volume import Grid, Volume
from recon.voxels.matter_checks import Unexplained
from recon.voxels.view_weights import Wedge

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

_PROFILE = 16.0  # number of voxels on each side of an edge
_BESIDE = 0.5  # inches; size of small labels
_BESIDE_BAR = WIDTH - LEFT - BAR


def projection(data: NDArray[np.float32], geometry: Geometry, view: int, unit: str) -> bytes:
    """One corrected projection [row, col] with the rotation axis, as the camera sees it: row 0 at the top, z
    downwards."""
    rows, cols = geometry.detector_shape
    pitch = geometry.sample_pitch
    left, right = -0.5 - geometry.axis_col, cols - 0.5 - geometry.axis_col
    thin = rows < THIN * cols
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
    """All projections of one detector row, in the order of their angles."""
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
    finish(axes, "column (px)", "angle (°)", f"Sinogram of row {row}, {len(order)} projections")
    add_bar(figure, image, "line integral")
    return png(figure)


def orthogonal_slices(
    volumes: Mapping[str, Volume],
    unit: str,
    kind: VoxelKind = VoxelKind.ATTENUATION,
) -> bytes:
    """For each volume, a row of three orthogonal slices, all in one grey window; y and z downwards, as image viewers
    show them.

    The slices intersect at the centre of mass of the bright voxels of the last volume.

    Args:
        volumes: the volumes by name, all on the same grid. unit: unit of length. kind: physical quantity of the voxels.
    """
    first = next(iter(volumes.values())).grid
    nz, ny, nx = first.shape
    centre = bright_centre(list(volumes.values())[-1].data)
    greys = material_window(*(image for volume in volumes.values() for image in _orthogonal_cuts(volume, centre)))
    height = max(ny / nx, nz / nx, nz / ny, THIN)
    column = min((WIDTH - _BESIDE - BAR - 2 * _BESIDE) / 3, 12 / (height * len(volumes)))
    down = [column * height] * len(volumes)
    figure, rows = panels([column] * 3, down, dpi_for(nx, column), left=_BESIDE, gap=_BESIDE, right=BAR)
    for row, (name, volume) in zip(rows, volumes.items(), strict=True):
        shown = _draw_cuts(row, volume, centre, unit, name, greys, "gray")
    add_bar(figure, shown, kind.label(unit), size=7)
    return png(figure)


def _orthogonal_cuts(volume: Volume, centre: Sequence[int]) -> list[NDArray[np.float32]]:
    """The slices across z, y and x through a voxel."""
    return [volume.data[(slice(None),) * i + (place,)] for i, place in enumerate(centre)]


def _draw_cuts(
    row: Sequence[Axes], volume: Volume, centre: Sequence[int], unit: str, name: str, window: GreyWindow, colours: str
) -> AxesImage:
    """Draw the orthogonal slices through a voxel side by side. The first slice has the name as its heading."""
    centres, cuts = volume.grid.coordinates(), _orthogonal_cuts(volume, centre)
    for i, (axes, image, plane) in enumerate(zip(row, cuts, planes(volume.grid, unit), strict=True)):
        place = f"{'zyx'[i]} = {centres[i][centre[i]]:.3g} {unit}"
        shown = draw_slice(axes, image, plane, f"{name}, {place}" if name and i == 0 else place, window, colours, 7)
    return shown


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

    The line lies in the slice z of `orthogonal_slices`. It runs along the gradient at the point at which the gradient
    is largest after a blur of a voxel. Because of the blur, single noisy voxels do not count as edges.
    """
    from matplotlib.ticker import MaxNLocator, NullFormatter

    last = list(volumes.values())[-1].data
    z = bright_centre(last)[0]
    smooth = np.pad(ndimage.gaussian_filter(last[z].astype(np.float64), 1.0), 1, mode="edge")
    down, across = (part[1:-1, 1:-1] for part in np.gradient(smooth))
    y, x = np.unravel_index(int(np.argmax(np.hypot(down, across))), down.shape)
    angle = math.atan2(down[y, x], across[y, x])
    t = np.arange(-_PROFILE, _PROFILE + 0.25, 0.5)
    figure, ((profile_axes, right),) = panels([3.27, 3.27], [2.35], gap=LEFT)
    for name, volume in volumes.items():
        points = (y + t * math.sin(angle), x + t * math.cos(angle))
        line = ndimage.map_coordinates(volume.data[z], points, order=1, mode="constant", cval=np.nan)
        profile_axes.plot(t * volume.grid.voxel_size, line, lw=1.2, label=name)
        few = volume.data[tuple(slice(None, None, max(1, n // LOOKED_AT)) for n in volume.data.shape)]
        low, high = grey_window([few], 0.05, 99.95)
        count, edges = np.histogram(few, bins=120, range=(low, high))
        right.stairs(count / few.size, edges, lw=1.2, label=name)
    profile_axes.xaxis.set_major_locator(MaxNLocator(5))
    right.set_yscale("log")
    right.yaxis.set_major_formatter("{x:g}")  # powers drawn as formulas take as long as all of the rest
    # choosing which ticks of a decade to label takes long, so none is labelled
    right.yaxis.set_minor_formatter(NullFormatter())
    edge = f"Edge at y = {y}, x = {x} of slice {z} (voxels)"
    finish(profile_axes, f"along the line ({unit})", kind.label(unit), edge, 9, grid=True)
    finish(right, kind.label(unit), "share of voxels", "Values", 9, grid=True)
    return png(figure)


def significance(image: NDArray[np.float32], grid: Grid, index: int, unit: str) -> bytes:
    """A slice [y, x] of the back-projected residual, in units of its noise. `at` is the number of the slice in the
    volume."""
    return _map(image, grid, unit, f"Slice {index}", "standard deviations of the noise", (-8.0, 8.0), "RdBu_r")


def stray_mass(image: NDArray[np.float32], grid: Grid, unit: str, kind: VoxelKind = VoxelKind.ATTENUATION) -> bytes:
    """A map [y, x] of the density in voxels that the projections show to be empty."""
    window, title = (float(np.min(image)), float(np.max(image))), "Highest density where projections show nothing"
    return _map(image, grid, unit, title, kind.label(unit), window, "magma")


def _map(
    image: NDArray[np.float32], grid: Grid, unit: str, title: str, label: str, window: GreyWindow, colours: str
) -> bytes:
    """An image [y, x] of a slice of the grid, with a colour bar."""
    figure, axes = one_panel(5.4, 6.4)
    drawn = draw_slice(axes, image, planes(grid, unit)[0], title, window, colours)
    figure.colorbar(drawn, ax=axes, label=label, pad=0.02)
    return png(figure)


def wedges(volume: Volume, unseen: Sequence[Wedge], unit: str) -> bytes:
    """A slice through the bright voxels. Sectors about the axis show the directions of missing rays."""
    from matplotlib.patches import Wedge as Sector

    middle, grid = bright_centre(volume.data)[0], volume.grid
    figure, axes = one_panel(5.4, 6.4)
    image, title = volume.data[middle], f"Rays that no projection has, slice {middle}"
    draw_slice(axes, image, planes(grid, unit)[0], title, material_window(image))
    radius = 0.48 * grid.shape[2] * grid.voxel_size
    for wedge in unseen:
        first, last = wedge.rays
        for turn in (0, 180):  # a ray has two directions
            sector = Sector((0, 0), radius, first + turn, last + turn, facecolor=("tab:orange", 0.08))
            sector.set(edgecolor="tab:orange", linewidth=1.2)
            axes.add_patch(sector)
    return png(figure)


def error_bars(volume: Volume, deviation: Volume, unit: str, kind: VoxelKind = VoxelKind.ATTENUATION) -> bytes:
    """A slice through the bright voxels, and its standard deviation, each with its colour bar and a scale bar."""
    middle, grid = bright_centre(volume.data)[0], volume.grid
    figure = new_figure((WIDTH, 4.4), dpi_for(grid.shape[2], WIDTH / 2.4))
    length = round_length(grid.shape[2] * grid.voxel_size / 5)
    panels = (
        (volume.data[middle], kind.value, "gray", material_window(volume.data[middle])),
        (deviation.data[middle], "standard deviation", "magma", grey_window([deviation.data[middle]], 0.5, 99.5)),
    )
    for axes, (image, label, colours, window) in zip(figure.subplots(1, 2), panels, strict=True):
        drawn = draw_slice(axes, image, planes(grid, unit)[0], f"Slice {middle}", window, colours)
        left, _, _, top = drawn.get_extent()
        across, down = [left + length / 4, left + 5 * length / 4], top + length / 4
        axes.plot(across, [down, down], color="white", lw=3, solid_capstyle="butt")
        axes.text(across[0], down + length / 8, f"{length:g} {unit}", color="white", fontsize=8, va="top")
        figure.colorbar(drawn, ax=axes, label=f"{label} ({kind.unit(unit)})", shrink=0.8)
    return png(figure)


def change(
    volume: Volume, change: Volume, unexplained: Unexplained | None, unit: str, kind: VoxelKind = VoxelKind.ATTENUATION
) -> bytes:
    """The slice with the largest change: the reference, the volume, the volume minus the reference, and the change in
    the projections divided by its standard error.

    Args:
        unexplained: what the moved reference leaves of the projections, of some slices; None: not known.
    """
    looked = (
        slice(None)
        if unexplained is None
        else slice(unexplained.first, unexplained.first + len(unexplained.significance))
    )
    first = looked.start or 0
    slice_number, grid = first + int(np.argmax([np.square(part).sum() for part in change.data[looked]])), volume.grid
    window = material_window(volume.data[slice_number])
    largest_change = float(np.percentile(np.abs(change.data[slice_number]), 99.5)) or 1.0
    down, across = (1, 3) if unexplained is None else (2, 2)
    figure = new_figure((WIDTH, 3.4 * down), dpi_for(grid.shape[2], WIDTH / 1.3 / across))
    panels = [
        (
            volume.data[slice_number] - change.data[slice_number],
            f"Moved reference, slice {slice_number}",
            window,
            "gray",
        ),
        (volume.data[slice_number], f"Volume, slice {slice_number}", window, "gray"),
        (change.data[slice_number], f"Change ({kind.unit(unit)})", (-largest_change, largest_change), "RdBu_r"),
    ]
    if unexplained is not None:
        panels.append(
            (unexplained.significance[slice_number - first], "Change / standard error", (-8.0, 8.0), "RdBu_r")
        )
    for axes, (image, title, limits, colours) in zip(figure.subplots(down, across).flat, panels, strict=True):
        drawn = draw_slice(axes, image, planes(grid, unit)[0], title, limits, colours, 8)
        figure.colorbar(drawn, ax=axes, shrink=0.8)
    return png(figure)


def axis_curve(candidates: NDArray[np.float64], curve: NDArray[np.float64], value: float, confident: bool) -> bytes:
    """The mismatch of the projections for each candidate column of the rotation axis, with the chosen column."""
    figure, ((axes,),) = panels([WIDTH - LEFT - GAP], [1.95])
    axes.plot(candidates, curve, color="0.25", lw=1.2)
    axes.axvline(value, color="tab:orange", lw=1.2, ls="--", label=f"axis {value:.2f} px")
    title = "Rotation axis: " + ("a clear optimum" if confident else "NOT a clear optimum")
    finish(axes, "axis candidate (column, px)", "mismatch", title, grid=True)
    return png(figure)


def pose_curves(
    angles_deg: NDArray[np.float64], shifts: NDArray[np.float64], turns_deg: NDArray[np.float64], unit: str
) -> bytes:
    """Displacement (col, row) of the projections in `unit`, and their roll and tilt in degrees, plotted against the
    angle."""
    curves = [(shifts, unit, ("along the columns", "along the rows")), (turns_deg, "degrees", ("roll", "tilt"))]
    shown = [curve for curve in curves if curve[0].any()]
    figure = new_figure((WIDTH, 2.4 * len(shown)))
    order = np.argsort(angles_deg, kind="stable")
    for axes, (values, label, names) in zip(np.ravel(figure.subplots(len(shown), sharex=True)), shown, strict=True):
        for column, name in enumerate(names):
            axes.plot(angles_deg[order], values[order, column], lw=1.0, marker=".", ms=2, label=name)
        finish(axes, "angle (degrees)", label, grid=True)
    return png(figure)
