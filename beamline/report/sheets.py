"""Sheets of images with the same grey window: one slice of many volumes, flagged frames, darks and flats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from beamline.report.figures import (
    WIDTH,
    GreyWindow,
    bright_centre,
    dpi_for,
    finish,
    grey_window,
    new_figure,
    panels,
    png,
    show_image,
)
from recon.base.arrays import F32
from recon.base.greys import material_window

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage


COLUMNS = 4
_CROP = 200
"""Pixels per side. Of larger slices, only the part in which they differ most is shown. Four columns of this size are
800 pixels wide, which every screen can show without scaling."""


class SliceSheet:
    """The slice [y, x] of each volume, by label. Position and grey window are those of the bright parts of the first
    volume.

    Args:
        down: name of the axis that points down, if the volumes are turned.
        across: number of slices side by side.
        closer: True: show the middle slice instead, in one grey window for all slices. If slices are large, only the
            part in which they differ most is shown.
    """

    def __init__(self, down: str = "y", across: int = COLUMNS, *, closer: bool = False) -> None:
        self._down, self._across, self._closer = down, across, closer
        self._at, self._window = 0, (0.0, 1.0)
        self._shown: dict[str, F32] = {}
        self._drawn: set[tuple[str, str]] = set()

    def add(self, label: str, volume: F32, family: str = "", method: str = "") -> None:
        """Add a slice of the volume. For each family and method, only the first volume is shown."""
        if family and (family, method) in self._drawn:
            return
        if not self._shown:
            self._at, self._window = bright_centre(volume)[0], material_window(volume)
        self._drawn.add((family, method))
        self._shown[label] = volume[len(volume) // 2 if self._closer else self._at].copy()

    def labels(self, method: str = "") -> list[str]:
        """The labels of slices that do not belong to a row, then the labels of slices of a method ("": no method)."""
        return [label for label in self._shown if label.rpartition(": ")[2] in (label, method)]

    def png(self, labels: Sequence[str], marks: Mapping[str, tuple[str, str]] | None = None) -> bytes:
        """PNG of these slices. All are drawn in the size of the largest slice.

        Args:
            marks: for each label, a line of text below it and the colour of a frame; empty: neither.
        """
        from matplotlib.patches import Rectangle

        images, window = [self._shown[label] for label in labels], self._window
        if self._closer:
            images = [image[_differ_most(images)] for image in images]
            window = material_window(*images)
        rows, cols = np.max([image.shape for image in images], axis=0).tolist()
        gap, down, lines = round(0.04 * cols), -(-len(labels) // self._across), 3 if marks else 2
        head = round(0.06 * lines * cols)
        # Drawn as one image, because a panel for each slice would take ten times as long.
        sheet = np.full((down * (rows + head), self._across * (cols + gap)), np.nan, np.float32)
        size = (WIDTH, WIDTH * sheet.shape[0] / sheet.shape[1])
        figure = new_figure(size, dpi_for(sheet.shape[1], WIDTH), False)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        for i, (label, image) in enumerate(zip(labels, images, strict=True)):
            top, left = i // self._across * (rows + head) + head, i % self._across * (cols + gap)
            nearest = (np.arange(n) * own // n for n, own in zip((rows, cols), image.shape, strict=True))
            sheet[top : top + rows, left : left + cols] = image[np.ix_(*nearest)]
            below, colour = (marks or {}).get(label, ("", ""))
            words = "\n".join(filter(None, (label.rpartition(": ")[0] or label, below)))
            axes.text(
                left + cols / 2, top - 0.8 * head / lines, words, fontsize=7, ha="center", color=colour or "black"
            )
            if colour:
                axes.add_patch(Rectangle((left - 0.5, top - 0.5), cols, rows, fill=False, ec=colour, lw=2.5))
        axes.text(0.02 * cols, head + 0.95 * rows, f"x → {self._down} ↓", fontsize=6, color="tab:orange")
        axes.imshow(sheet, cmap="gray", vmin=window[0], vmax=window[1], interpolation="nearest", aspect="auto")
        return png(figure)


def _differ_most(images: Sequence[F32]) -> tuple[slice, slice]:
    """The square in which images of equal size differ most. If they are small or differ in size, the whole images."""
    shape = images[0].shape
    if max(shape) <= _CROP or any(image.shape != shape for image in images):
        return slice(None), slice(None)
    size = tuple(min(_CROP, n) for n in shape)
    sums = ndimage.uniform_filter(np.ptp(np.stack(images), axis=0), size, mode="constant")
    # number of squares in the image
    whole = [slice(n // 2, side - (n - 1) // 2) for n, side in zip(size, shape, strict=True)]
    place = np.unravel_index(int(np.argmax(sums[tuple(whole)])), sums[tuple(whole)].shape)
    rows, cols = (slice(int(first), int(first) + n) for first, n in zip(place, size, strict=True))
    return rows, cols


@dataclass(frozen=True, eq=False)
class FlaggedFrame:
    """A frame on the sheet.

    Attributes:
        image: [row, col] counts, binned if there are many.
        extent: (rows, cols) of the whole frame, in pixels of the detector.
        reasons: a line for each flag.
        regions: regions of the flags, in pixels of the detector (first row, row after the last, first column, column
            after the last), each with the colour of its box. colour: colour of the border around the image.
    """

    image: NDArray[np.float32]
    extent: tuple[int, int]
    title: str
    reasons: Sequence[str]
    regions: Sequence[tuple[tuple[int, int, int, int], str]]
    colour: str = "black"


def contact_sheet(frames: Sequence[FlaggedFrame], window: GreyWindow | None = None, title: str = "") -> bytes:
    """The frames as PNG, row 0 at the top, in one grey window (None: computed from all frames), with a box around each
    region."""
    from matplotlib.patches import Rectangle

    down = -(-len(frames) // COLUMNS)
    lines = max(len(frame.reasons) for frame in frames)
    rows, cols = frames[0].extent
    width = WIDTH / COLUMNS
    height = np.clip(width * rows / cols, 0.5, 3.0) + 0.25 + 0.13 * lines
    figure = new_figure((WIDTH, float(height) * down + 0.25 * bool(title)))
    figure.suptitle(title, fontsize=8)
    window = window or grey_window([frame.image for frame in frames], 0.5, 99.5)
    panels = np.ravel(figure.subplots(down, COLUMNS, squeeze=False))
    for axes in panels[len(frames) :]:
        axes.set_axis_off()
    for axes, frame in zip(panels, frames, strict=False):
        _show(axes, frame.image, window, frame.extent)
        for (top, bottom, left, right), colour in frame.regions:
            box = Rectangle((left - 0.5, top - 0.5), right - left, bottom - top, fill=False, ec=colour, lw=1.2)
            axes.add_patch(box)
        for side in axes.spines.values():
            side.set(color=frame.colour, linewidth=1.5)
        finish(axes, "", "", "\n".join([frame.title, *frame.reasons]), 6)
    return png(figure)


def reference_sheet(images: Mapping[str, NDArray[np.float32]], shape: tuple[int, int]) -> bytes:
    """Mean darks and flats as PNG, row 0 at the top, each in its own grey window with its scale.

    Args:
        images: the images [row, col] by title, as counts or ratios, binned if they are large. shape: (rows, cols) of
            the detector.
    """
    rows, cols = shape
    width = WIDTH / max(len(images), 2) - 1.3
    high = float(np.clip(0.85 * width * rows / cols, 0.6, 4.0))
    figure, (row,) = panels([width] * len(images), [high], gap=1.3, right=0.5)
    for axes, (title, image) in zip(row, images.items(), strict=True):
        shown = _show(axes, image, grey_window([image], 0.5, 99.5), shape)
        finish(axes, "column", "← row", title, 7)
        figure.colorbar(shown, ax=axes, fraction=0.05, pad=0.02).ax.tick_params(labelsize=6)
    return png(figure)


def _show(axes: Axes, image: NDArray[np.float32], window: GreyWindow, shape: tuple[int, int]) -> AxesImage:
    """Draw an image of the whole detector. Its axes are in pixels of the detector, whose rows and columns are
    `shape`."""
    rows, cols = shape
    edges = -0.5, cols - 0.5, rows - 0.5, -0.5
    return show_image(axes, image, window, edges, stretched=rows < 0.15 * cols)
