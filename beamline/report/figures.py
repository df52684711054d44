"""Pictures for reports: arrays to PNG bytes, with labelled axes, units and a stated grey window."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, ScalarFormatter
from numpy.typing import NDArray
from scipy import ndimage

from beamline.report.record import residual_curve
from recon.assess.time_model import NextDecibel, duration_text, record
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume

Window = tuple[float, float]
_DPI = 110
_WIDTH = 8.6  # inches; the report's column
_PROFILE = 16.0  # voxels to either side of an edge
_LOOKED_AT = 256  # slices along each axis, at least, of a volume that has more
_THIN = 0.06  # an image with a smaller ratio of height to width is stretched


def grey_window(arrays: Sequence[NDArray[np.floating]], low: float = 1.0, high: float = 99.5) -> Window:
    """One range of grey values for all `arrays`: percentiles of their values together."""
    finite = np.concatenate([a[np.isfinite(a)].ravel() for a in arrays])
    if finite.size == 0:
        return 0.0, 1.0
    bottom, top = (float(v) for v in np.percentile(finite, [low, high]))
    return (bottom, top) if top > bottom else (bottom, bottom + 1.0)


def projection(data: NDArray[np.float32], geometry: Geometry, view: int, unit: str) -> bytes:
    """One corrected view [row, col] with the rotation axis, as the camera sees it: row 0 at the top, z downwards."""
    rows, cols = geometry.detector_shape
    pitch = geometry.sample_pitch
    left, right = -0.5 - geometry.axis_col, cols - 0.5 - geometry.axis_col
    height = np.clip(0.82 * _WIDTH * rows / cols, 1.6, 6.0)
    thin = rows < _THIN * cols
    figure, axes = _figure((_WIDTH, height + 0.8))
    image = axes.imshow(
        data[view],
        cmap="gray",
        extent=(left * pitch, right * pitch, rows / 2 * pitch, -rows / 2 * pitch),
        aspect="auto" if thin else "equal",
        interpolation="nearest",
        norm=Normalize(*grey_window([data[view]])),
    )
    axes.axvline(0.0, color="tab:orange", lw=1, ls="--", label="rotation axis")
    axes.legend(loc="upper right", fontsize=8, framealpha=0.8)
    axes.set(
        xlabel=f"u ({unit})",
        ylabel=f"z ({unit})",
        title=f"View at {np.degrees(geometry.angles[view]):.2f}°",
    )
    figure.colorbar(image, ax=axes, label="line integral", shrink=0.9, pad=0.02)
    return png(figure)


def sinogram(data: NDArray[np.float32], geometry: Geometry, row: int) -> bytes:
    """All views of one detector row, in order of angle."""
    order = np.argsort(geometry.angles, kind="stable")
    angles = np.degrees(geometry.angles[order])
    image_rows = data[order, row]
    figure, axes = _figure((_WIDTH, 4.2))
    image = axes.imshow(
        image_rows, cmap="gray", aspect="auto", interpolation="nearest", norm=Normalize(*grey_window([image_rows]))
    )
    axes.axvline(geometry.axis_col, color="tab:orange", lw=1, ls="--", label="rotation axis")
    axes.legend(loc="upper right", fontsize=8, framealpha=0.8)
    ticks = MaxNLocator(7, steps=[1, 1.5, 2, 3, 4.5, 6, 9, 10]).tick_values(angles[0], angles[-1])
    ticks = ticks[(ticks >= angles[0]) & (ticks <= angles[-1])]
    axes.set_yticks(np.interp(ticks, angles, np.arange(len(order))), [f"{angle:g}" for angle in ticks])
    axes.set(xlabel="column (px)", ylabel="angle (°)", title=f"Sinogram of row {row}, {len(order)} views")
    figure.colorbar(image, ax=axes, label="line integral", pad=0.02)
    return png(figure)


def orthogonal_slices(volumes: Mapping[str, Volume], unit: str, percentiles: Window = (1.0, 99.5)) -> bytes:
    """Three orthogonal slices through each volume, side by side in one grey window; z downwards, as the camera sees it.

    They intersect at the centre of mass of the bright voxels of the last volume.

    Args:
        volumes: by name, all on the same grid.
        unit: of length; the volumes are in 1/unit.
        percentiles: of all the values shown, which become black and white.
    """
    first = next(iter(volumes.values())).grid
    nz, ny, nx = first.shape
    at = bright_centre(list(volumes.values())[-1].data)
    slices = {name: (v.data[at[0]], v.data[:, at[1]], v.data[:, :, at[2]]) for name, v in volumes.items()}
    window = grey_window([image for images in slices.values() for image in images], *percentiles)
    heights = [max(ny / nx, _THIN), max(nz / nx, _THIN), max(nz / ny, _THIN)]
    column = min((_WIDTH - 1.2) / len(volumes), 4.6, 12 / sum(heights))
    size = (1.2 + column * len(volumes), 0.9 + (column - 0.35) * sum(heights) + 0.33 * len(heights))
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    panels = figure.subplots(3, len(volumes), squeeze=False, height_ratios=heights)
    z, y, x = (_edges(first.centre[i], first.shape[i], first.voxel_size) for i in range(3))
    planes = (("x", "y", x, y), ("x", "z", x, z[::-1]), ("y", "z", y, z[::-1]))
    for j, (name, images) in enumerate(slices.items()):
        for i, (image, (across, up, h_edges, v_edges)) in enumerate(zip(images, planes, strict=True)):
            axes = panels[i][j]
            thin = image.shape[0] < _THIN * image.shape[1]
            shown = axes.imshow(
                image,
                cmap="gray",
                origin="upper" if up == "z" else "lower",
                extent=(*h_edges, *v_edges),
                aspect="auto" if thin else "equal",
                interpolation="nearest",
                norm=Normalize(*window),
            )
            axes.tick_params(labelsize=7)
            axes.set_xlabel(f"{across} ({unit})", fontsize=8)
            if j == 0:
                axes.set_ylabel(f"{up} ({unit})", fontsize=8)
                cut = first.coordinates()[i][at[i]]
                text = axes.text(0.02, 0.04, f"{'zyx'[i]} = {cut:.3g} {unit}", fontsize=7, transform=axes.transAxes)
                text.set_bbox({"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1.5})
            else:
                axes.tick_params(labelleft=False)
            if i == 0:
                axes.set_title(name, fontsize=11)
    bar = figure.colorbar(shown, ax=panels, shrink=0.6, pad=0.02, aspect=30)
    bar.set_label(f"attenuation (1/{unit})")
    return png(figure)


def profile_and_values(volumes: Mapping[str, Volume], unit: str) -> bytes:
    """Each volume along a line through the sharpest edge of the last one, and how often its values occur.

    The line lies in the slice z of `orthogonal_slices`, along the gradient where that is largest after a blur of a
    voxel, so that single noisy voxels are no edges.
    """
    last = list(volumes.values())[-1].data
    z = bright_centre(last)[0]
    smooth = np.pad(ndimage.gaussian_filter(last[z].astype(np.float64), 1.0), 1, mode="edge")
    down, across = (part[1:-1, 1:-1] for part in np.gradient(smooth))
    y, x = np.unravel_index(int(np.argmax(np.hypot(down, across))), down.shape)
    angle = math.atan2(down[y, x], across[y, x])
    t = np.arange(-_PROFILE, _PROFILE + 0.25, 0.5)
    figure = Figure(figsize=(_WIDTH, 3.2), dpi=_DPI, layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, volume in volumes.items():
        at = (y + t * math.sin(angle), x + t * math.cos(angle))
        line = ndimage.map_coordinates(volume.data[z], at, order=1, mode="constant", cval=np.nan)
        left.plot(t * volume.grid.voxel_size, line, lw=1.2, label=name)
        few = volume.data[tuple(slice(None, None, max(1, n // _LOOKED_AT)) for n in volume.data.shape)]
        low, high = grey_window([few], 0.05, 99.95)
        count, edges = np.histogram(few, bins=120, range=(low, high))
        right.stairs(count / few.size, edges, lw=1.2, label=name)
    left.set(xlabel=f"along the line ({unit})", ylabel=f"attenuation (1/{unit})")
    left.set_title(f"Edge at y = {y}, x = {x} of slice {z} (voxels)", fontsize=9)
    right.set(xlabel=f"attenuation (1/{unit})", ylabel="share of voxels", yscale="log")
    right.set_title("Values", fontsize=9)
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    return png(figure)


def significance(image: NDArray[np.float32], grid: Grid, at: int, unit: str) -> bytes:
    """A slice [y, x] of the residual's back-projection in units of its noise; `at` is its number in the volume."""
    figure, axes = _figure((6.4, 5.4))
    (y, x), (_, cy, cx) = image.shape, grid.centre
    extent = (*_edges(cx, x, grid.voxel_size), *_edges(cy, y, grid.voxel_size))
    shown = axes.imshow(
        image, cmap="RdBu_r", origin="lower", extent=extent, norm=Normalize(-8, 8), interpolation="nearest"
    )
    axes.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})", title=f"Slice {at}")
    figure.colorbar(shown, ax=axes, label="standard deviations of the noise", pad=0.02)
    return png(figure)


def axis_curve(candidates: NDArray[np.float64], curve: NDArray[np.float64], value: float, confident: bool) -> bytes:
    """The mismatch of the views against the candidate columns of the rotation axis, with the chosen one."""
    figure, axes = _figure((_WIDTH, 2.8))
    axes.plot(candidates, curve, color="0.25", lw=1.2)
    axes.axvline(value, color="tab:orange", lw=1.2, ls="--", label=f"axis {value:.2f} px")
    axes.set(xlabel="axis candidate (column, px)", ylabel="mismatch")
    axes.set_title("Rotation axis: " + ("a clear optimum" if confident else "NOT a clear optimum"))
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    return png(figure)


def quality_against_time(
    history: Mapping[str, NDArray[np.floating]],
    psnr: Sequence[tuple[float, float]] = (),
    further: NextDecibel | None = None,
) -> bytes:
    """A fit against time: loss and residuals, the residual as dB, PSNR of snapshots, number of views and Gaussians.

    Args:
        history: equally long "seconds", "loss", and where known "residual", "held_out", "n_views", "n_gaussians".
        psnr: (seconds, dB) of each snapshot; none without a truth.
        further: time that another dB would take; None if it is not known.
    """
    seconds = history["seconds"]
    growing = [
        (name, label)
        for name, label in (("n_views", "views"), ("n_gaussians", "Gaussians"))
        if name in history and np.ptp(history[name]) > 0
    ]
    curve = residual_curve(history)
    panels = 1 + (curve is not None) + bool(psnr) + bool(growing)
    down, across = (1, panels) if panels < 4 else (2, 2)
    figure = Figure(figsize=(_WIDTH, 3.1 * down), dpi=_DPI, layout="constrained")
    left, *others = np.ravel(figure.subplots(down, across))
    for name, label, colour in (
        ("loss", "loss", "tab:blue"),
        ("residual", "residual", "tab:orange"),
        ("held_out", "residual, held out", "tab:red"),
    ):
        if name == "loss" and np.array_equal(history[name], history.get("residual", [])):
            continue  # the loss of iterations is the residual itself
        if name in history and np.any(np.isfinite(history[name])):
            left.plot(seconds, history[name], color=colour, lw=1.2, marker=".", ms=3, label=label)
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=np.float64) for line in left.get_lines()])
    if values.min(initial=np.inf) > 0 and values.max() > 10 * values.min():
        left.set_yscale("log")
        left.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
        left.yaxis.set_major_formatter(ScalarFormatter())
        left.yaxis.set_minor_formatter(NullFormatter())
    else:
        left.set_ylim(bottom=0)
    left.set(xlabel="time (s)", title="Misfit")
    left.legend(fontsize=8)
    if curve is not None:
        _decibels(others.pop(0), *record(curve.seconds, curve.residuals), curve.views, further)
    if psnr:
        axes = others.pop(0)
        axes.plot(*np.array(psnr).T, color="tab:green", lw=1.2, marker="o", ms=3)
        axes.set(xlabel="time (s)", ylabel="PSNR (dB)", title="Quality against the truth")
    if growing:
        axes = others.pop(0)
        for (name, label), colour in zip(growing, ("tab:purple", "0.4"), strict=False):
            values = history[name] / np.max(history[name])
            axes.step(seconds, values, where="post", color=colour, lw=1.2, label=f"{label} / {history[name].max():.0f}")
        axes.set(xlabel="time (s)", ylabel="share of the largest", ylim=(0, 1.05), title="Growth")
        axes.legend(fontsize=8, loc="lower right")
    for panel in figure.axes:
        panel.grid(alpha=0.3)
        panel.tick_params(labelsize=8)
    return png(figure)


def _decibels(
    axes: Axes, seconds: NDArray[np.float64], quality: NDArray[np.float64], views: str, further: NextDecibel | None
) -> None:
    """The residual as dB below the data, and the time at which the next dB is expected."""
    axes.plot(seconds, quality, color="tab:green", lw=1.2, marker=".", ms=3)
    axes.set(xlabel="time (s)", ylabel="dB below the data", title=f"Residual, {views}")
    if further is None or seconds.size == 0:
        return
    if not further.measurable:
        axes.text(0.97, 0.05, "next dB: none measurable", ha="right", fontsize=8, transform=axes.transAxes)
        return
    note = f"next dB of the {further.of}: about {duration_text(further.seconds)} more"
    axes.text(0.97, 0.05, note, ha="right", fontsize=8, transform=axes.transAxes)
    if further.of == "volume":
        return  # this curve is the residual, not the quality of the volume
    end, top = float(seconds[-1]), float(quality[-1])
    axes.plot([end, end + further.seconds], [top, top + 1], color="tab:green", lw=1, ls=":")
    high = further.high if math.isfinite(further.high) else 3 * further.seconds
    axes.plot([end + further.low, end + high], [top + 1, top + 1], color="0.4", lw=1)
    axes.plot([end + further.seconds], [top + 1], color="0.4", marker="|", ms=8)


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


def _edges(centre: float, n: int, size: float) -> tuple[float, float]:
    return centre - n / 2 * size, centre + n / 2 * size


def _figure(size: tuple[float, float]) -> tuple[Figure, Axes]:
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    return figure, figure.subplots()


def png(figure: Figure, compression: int = 6) -> bytes:
    """The figure's bytes as PNG; `compression` 1 takes the least time, 9 gives the fewest bytes."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, pil_kwargs={"compress_level": compression})
    return buffer.getvalue()
