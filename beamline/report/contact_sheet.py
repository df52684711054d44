"""Contact sheet: flagged frames side by side, each with its reason and the place where it is flagged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from beamline.report.figures import grey_window, png

COLUMNS = 4
_WIDTH, _DPI = 8.6, 110  # as all pictures of a report
_COLOURS = {True: "tab:red", False: "tab:orange"}  # of alarms and of warnings


@dataclass(frozen=True, eq=False)
class FlaggedFrame:
    """A frame for the sheet.

    Attributes:
        image: [row, col] counts, binned where there are many.
        extent: (rows, cols) of the whole frame, in pixels of the detector.
        title: which frame it is.
        reasons: a line for each flag.
        regions: of the flags, in pixels of the detector: first row, row after the last, first column, column after
            the last.
        alarm: a flag is an alarm.
    """

    image: NDArray[np.float32]
    extent: tuple[int, int]
    title: str
    reasons: Sequence[str]
    regions: Sequence[tuple[int, int, int, int]]
    alarm: bool


def contact_sheet(frames: Sequence[FlaggedFrame]) -> bytes:
    """The frames as PNG, row 0 at the top, in one grey window, with a box around each region."""
    down = -(-len(frames) // COLUMNS)
    lines = max(len(frame.reasons) for frame in frames)
    rows, cols = frames[0].extent
    width = _WIDTH / COLUMNS
    height = np.clip(width * rows / cols, 0.5, 3.0) + 0.25 + 0.13 * lines
    figure = Figure(figsize=(_WIDTH, float(height) * down), dpi=_DPI, layout="constrained")
    window = Normalize(*grey_window([frame.image for frame in frames], 0.5, 99.5))
    panels = np.ravel(figure.subplots(down, COLUMNS, squeeze=False))
    for axes in panels[len(frames) :]:
        axes.set_axis_off()
    for axes, frame in zip(panels, frames, strict=False):
        rows, cols = frame.extent
        thin = rows < 0.15 * cols
        axes.imshow(
            frame.image,
            cmap="gray",
            norm=window,
            extent=(-0.5, cols - 0.5, rows - 0.5, -0.5),
            aspect="auto" if thin else "equal",
            interpolation="nearest",
        )
        colour = _COLOURS[frame.alarm]
        for top, bottom, left, right in frame.regions:
            box = Rectangle((left - 0.5, top - 0.5), right - left, bottom - top, fill=False, ec=colour, lw=1.2)
            axes.add_patch(box)
        for side in axes.spines.values():
            side.set(color=colour, linewidth=1.5)
        axes.tick_params(labelsize=5, length=2)
        axes.set_title("\n".join([frame.title, *frame.reasons]), fontsize=6.5)
    return png(figure)
