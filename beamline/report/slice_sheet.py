"""Slice sheet: the same slice of many volumes side by side, in one grey window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from beamline.report.figures import WIDTH, bright_centre, dpi_for, new_figure, png
from recon.base.arrays import F32
from recon.base.greys import matter_window

_COLUMNS = 4


class SliceSheet:
    """The slice [y, x] of each volume through the bright parts of the first one, by label.

    `down`: name of the axis that goes down, of volumes that are turned.
    """

    def __init__(self, down: str = "y") -> None:
        self._at, self._down = 0, down
        self._shown: dict[str, F32] = {}
        self._drawn: set[tuple[str, str]] = set()

    def add(self, label: str, volume: F32, family: str = "", method: str = "") -> None:
        """Adds a slice of the volume; of each family and method, only the first volume counts."""
        if family and (family, method) in self._drawn:
            return
        if not self._shown:
            self._at = bright_centre(volume)[0]
        self._drawn.add((family, method))
        self._shown[label] = volume[self._at].copy()

    def labels(self, method: str = "") -> list[str]:
        """The labels of slices that belong to no row, then those of a method ("": none)."""
        return [label for label in self._shown if label.rpartition(": ")[2] in (label, method)]

    def png(self, labels: Sequence[str]) -> bytes:
        """These slices, four beside one another, in the grey window of the first."""
        low, high = matter_window(self._shown[labels[0]])
        rows, cols = self._shown[labels[0]].shape
        head, gap, down = round(0.12 * cols), round(0.04 * cols), -(-len(labels) // _COLUMNS)
        # One image: a panel for each slice takes ten times as long to draw.
        sheet = np.full((down * (rows + head), _COLUMNS * (cols + gap)), np.nan, np.float32)
        size = (WIDTH, WIDTH * sheet.shape[0] / sheet.shape[1])
        figure = new_figure(size, dpi_for(sheet.shape[1], WIDTH), False)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        for i, label in enumerate(labels):
            top, left = i // _COLUMNS * (rows + head), i % _COLUMNS * (cols + gap)
            sheet[top + head : top + head + rows, left : left + cols] = self._shown[label]
            axes.text(left + cols / 2, top + 0.6 * head, label.rpartition(": ")[0] or label, fontsize=7, ha="center")
        axes.text(0.02 * cols, head + 0.95 * rows, f"x → {self._down} ↓", fontsize=6, color="tab:orange")
        axes.imshow(sheet, cmap="gray", vmin=low, vmax=high, interpolation="nearest", aspect="auto")
        return png(figure)
