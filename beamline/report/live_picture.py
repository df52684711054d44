"""The picture of a volume that still grows: three slices, the newest view and what the volume says of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from beamline.report.figures import Window, bright_centre, grey_window, png
from recon.base.noise import noise_level
from recon.base.volume import Volume

F32 = NDArray[np.float32]
_DPI, _PANEL, _GAP, _LINE = 100, 280, 14, 15  # pixels: side of a panel, between panels, a line of text
_SIGMAS = 5.0  # range of the differences
_DIFFERENCES = LinearSegmentedColormap.from_list("differences", ["tab:blue", "white", "tab:red"])


@dataclass(frozen=True, eq=False)
class LivePicture:
    """What a picture shows.

    Attributes:
        volume: so far, 1/unit.
        view, render: the newest view [row, col] and that of the volume, line integrals.
        title: of the whole, one line.
        unit: of length, "mm" or "px".
    """

    volume: Volume
    view: F32
    render: F32
    title: str
    unit: str

    def png(self) -> bytes:
        """The picture. Without axes and layout, which would take ten times as long: it is drawn beside a fit."""
        width, height = 3 * _PANEL + 4 * _GAP, 2 * (_PANEL + 2 * _LINE) + 3 * _GAP + 2 * _LINE
        figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
        figure.text(_GAP / width, 1 - 1.6 * _LINE / height, self.title, fontsize=9, weight="bold")
        low = _GAP + _PANEL + 2 * _LINE + _GAP
        self._slices(figure, low)
        self._views(figure, _GAP)
        return png(figure, compression=1)

    def _slices(self, figure: Figure, bottom: int) -> None:
        grid, data = self.volume.grid, self.volume.data
        k, j, i = (1 + n // 100 for n in data.shape)  # the middle of what is bright need not be known to a voxel
        z, y, x = np.multiply((k, j, i), bright_centre(data[::k, ::j, ::i])).tolist()
        at = [axis[i] for axis, i in zip(grid.coordinates(), (z, y, x), strict=True)]
        images = (data[z], data[:, y], data[:, :, x])
        window = grey_window(images)
        grey = f"{window[0]:.3g} to {window[1]:.3g} 1/{self.unit}"
        labels = (f"x, y at z = {at[0]:.3g} {self.unit}", f"x, z at y = {at[1]:.3g}", f"y, z at x = {at[2]:.3g}")
        for k, (image, label) in enumerate(zip(images, labels, strict=True)):
            panel = _Panel(figure, k, bottom)
            step = panel.show(image, "gray", window)
            panel.say(label, grey if k == 0 else "the same greys")
            panel.scale(step * grid.voxel_size, self.unit)

    def _views(self, figure: Figure, bottom: int) -> None:
        window = grey_window([self.view], 0.5, 99.5)
        noise = noise_level(self.view[None]) or 0.01 * (window[1] - window[0])
        left = (self.view - self.render) / np.float32(noise)
        greys = f"line integral {window[0]:.3g} to {window[1]:.3g}"
        spread = f"white 0, red {_SIGMAS:g}, blue -{_SIGMAS:g}; RMS {math.sqrt(float(np.mean(left**2))):.2f}"
        panels: tuple[tuple[F32, str | LinearSegmentedColormap, Window, str, str], ...] = (
            (self.view, "gray", window, "newest view", greys),
            (self.render, "gray", window, "the volume seen from there", "the same greys"),
            (left, _DIFFERENCES, (-_SIGMAS, _SIGMAS), "difference in noise of a pixel", spread),
        )
        for k, (image, colours, limits, label, note) in enumerate(panels):
            panel = _Panel(figure, k, bottom)
            panel.show(image, colours, limits)
            panel.say(label, note)


@dataclass(frozen=True, eq=False)
class _Panel:
    """The k-th place of a row of panels, its bottom so many pixels above that of the figure."""

    figure: Figure
    k: int
    bottom: int

    @property
    def left(self) -> int:
        return _GAP + self.k * (_PANEL + _GAP)

    def show(self, image: F32, colours: str | LinearSegmentedColormap, limits: Window) -> float:
        """Draw the image in the lower left corner, row 0 at the bottom. Returns the size of a screen's pixel in its
        own."""
        pixels, step = _sized(image)
        low, high = limits
        self.figure.figimage(pixels, self.left, self.bottom, cmap=colours, vmin=low, vmax=high, origin="lower")
        return step

    def say(self, label: str, note: str) -> None:
        """Two lines above the panel."""
        width, height = self.figure.get_size_inches() * _DPI
        for line, (text, colour) in enumerate(((note, "0.35"), (label, "black"))):
            y = self.bottom + _PANEL + 4 + line * _LINE
            self.figure.text(self.left / width, y / height, text, fontsize=8, color=colour)

    def scale(self, pixel: float, unit: str) -> None:
        """A bar of a round length, at most a third of the panel; a pixel of the screen is `pixel` units wide."""
        longest = pixel * _PANEL / 3
        power = 10.0 ** math.floor(math.log10(longest))
        length = max(n * power for n in (1, 2, 5) if n * power <= longest)
        x, y = self.left + 6, self.bottom + 6
        bar = Line2D([x, x + length / pixel], [y, y], color="tab:orange", lw=3, transform=None, solid_capstyle="butt")
        self.figure.add_artist(bar)
        width, height = self.figure.get_size_inches() * _DPI
        text = f"{length:g} {unit}"
        self.figure.text(x / width, (y + 6) / height, text, fontsize=8, color="tab:orange", weight="bold")


def _sized(image: F32) -> tuple[F32, float]:
    """The image with pixels repeated, or means of several, so that it fits into a panel; its pixels in one of these."""
    longest = max(image.shape)
    if longest <= _PANEL:
        factor = _PANEL // longest
        return np.repeat(np.repeat(image, factor, 0), factor, 1), 1 / factor
    step = math.ceil(longest / _PANEL)
    rows, cols = (max(1, n // step) for n in image.shape)
    each = min(step, image.shape[0]), min(step, image.shape[1])
    cut = image[: rows * each[0], : cols * each[1]]
    return cut.reshape(rows, each[0], cols, each[1]).mean(axis=(1, 3)), float(step)
