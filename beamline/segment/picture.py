"""Picture of a segmented volume: slices with the outlines of their particles, and the sizes of all."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beamline.report.figures import downwards, grey_window, png, show_grey
from recon.base.volume import Volume
from recon.post.particles import Particles

_SLICES, _WIDTH, _DPI = 3, 8.6, 110
_COLOURS = 12


def picture_of(volume: Volume, unit: str, labels: NDArray[np.int32], particles: Particles) -> bytes:
    """Three slices as they are, the same with each particle in a colour, and a histogram of diameters, as PNG."""
    z, y, x = volume.grid.coordinates()
    at = np.linspace(0, z.size - 1, _SLICES + 2).round().astype(int)[1:-1]
    half = volume.grid.voxel_size / 2
    extent = (x[0] - half, x[-1] + half, y[-1] + half, y[0] - half)
    column = _WIDTH / _SLICES
    figure = Figure(figsize=(_WIDTH, 2 * column * y.size / x.size + 3.2), dpi=_DPI, layout="constrained")
    ratios = (2 * column * y.size / x.size + 0.8, 2.4)
    upper, lower = np.ravel(figure.subfigures(2, 1, squeeze=False, height_ratios=ratios))
    panels = upper.subplots(2, _SLICES, sharex=True, sharey=True)
    window = grey_window([volume.data[at]])
    # Neighbours in the order of labels get different colours; the same colour comes again after twelve.
    colours = ListedColormap([(0, 0, 0, 0), *figure_colours()])
    for column_of, k in zip(panels.T, at, strict=True):
        for axes in column_of:
            show_grey(axes, volume.data[k], window, extent)
            axes.tick_params(labelsize=6)
        shown = np.where(labels[k] > 0, (labels[k] - 1) % _COLOURS + 1, 0)
        shown[1:][(labels[k][1:] != labels[k][:-1]) & (labels[k][:-1] > 0)] = 0  # a line between those that touch
        shown[:, 1:][(labels[k][:, 1:] != labels[k][:, :-1]) & (labels[k][:, :-1] > 0)] = 0
        column_of[1].imshow(
            shown, cmap=colours, vmin=0, vmax=_COLOURS, extent=extent, interpolation="nearest", alpha=0.65
        )
        n = np.unique(labels[k]).size - bool((labels[k] == 0).any())
        column_of[1].set_xlabel(f"x ({unit})", fontsize=7)
        column_of[0].set_title(f"z = {z[k]:.3g} {unit}", fontsize=8)
        column_of[1].set_title(f"{n} particles here", fontsize=8)
    for axes in panels[:, 0]:
        axes.set_ylabel(downwards("y", unit), fontsize=7)
    axes = lower.subplots()
    whole = ~particles.cut
    if particles.label.size:
        bins = np.histogram_bin_edges(particles.diameter, bins=min(30, max(5, particles.label.size // 4)))
        parts = [particles.diameter[whole], particles.diameter[~whole]]
        axes.hist(parts, bins.tolist(), stacked=True, color=["tab:blue", "0.7"], label=["whole", "cut by a face"])
        axes.legend(fontsize=8)
    axes.set_xlabel(f"equivalent diameter ({unit})", fontsize=8)
    axes.set_ylabel("particles", fontsize=8)
    axes.set_title(f"{particles.label.size} particles, {int(particles.cut.sum())} of them cut by a face", fontsize=9)
    axes.tick_params(labelsize=7)
    return png(figure)


def figure_colours() -> list[tuple[float, float, float, float]]:
    """Twelve bright colours, neighbours far apart in hue."""
    from matplotlib import colormaps

    hues = np.mod(np.arange(_COLOURS) * 5 / _COLOURS, 1.0)  # 5 and 12 have no common factor
    return [tuple(colour) for colour in colormaps["hsv"](hues).tolist()]
